"""Choosing the Mitsuba variant, and what is said where it cannot be had."""

from __future__ import annotations

import gc

import drjit as dr
import mitsuba as mi
import pytest
from helpers import run_python

from mitsonar.errors import MitsonarError
from mitsonar.simulation.device import VARIANTS, backend, ensure_variant, replayed


def test_a_usable_variant_is_kept(variant: str) -> None:
    assert variant in VARIANTS
    assert mi.variant() == variant
    assert ensure_variant() == variant
    assert backend().variant == variant
    assert (backend().llvm is None) == variant.startswith("cuda")


@pytest.mark.usefixtures("variant")
def test_unknown_names_are_answered_by_the_nearest(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(MitsonarError, match=r"unknown variant 'llvm_mono': did you mean llvm_ad_mono"):
        ensure_variant("llvm_mono")
    monkeypatch.setenv("MITSONAR_VARIANT", "scalar_rgb")
    with pytest.raises(MitsonarError, match=r"unknown variant 'scalar_rgb'"):
        ensure_variant()


@pytest.mark.usefixtures("variant")
@pytest.mark.skipif(bool(dr.has_backend(dr.JitBackend.CUDA)), reason="there is a CUDA device")
def test_cuda_that_is_absent_is_said() -> None:
    with pytest.raises(MitsonarError, match=r"cuda_ad_mono needs an NVIDIA driver, and none was found: use llvm_ad_mono"):
        ensure_variant("cuda_ad_mono")


@pytest.mark.thorough
def test_environment_forces_a_variant_and_a_missing_llvm_is_named() -> None:
    script = """
        from mitsonar.simulation.device import ensure_variant
        try:
            print(ensure_variant())
        except ValueError as error:
            print(type(error).__name__, error)
    """
    output = run_python(script, MITSONAR_VARIANT="llvm_ad_rgb")
    assert output.splitlines()[-1] == "llvm_ad_rgb"
    output = run_python(script, MITSONAR_VARIANT="llvm_ad_rgb", DRJIT_LIBLLVM_PATH="/nonexistent/libLLVM.so")
    assert "MitsonarError the library libLLVM was not found" in output
    assert "apt-get install" in output


@pytest.mark.gpu
def test_cuda_and_llvm_see_the_same() -> None:
    """Ranges to 1e-4 m and total levels to 1e-4: ray tracers differ in the last bits only."""
    script = """
        import mitsonar, numpy as np
        from mitsonar.simulation.device import ensure_variant
        ensure_variant()
        import mitsuba as mi
        floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(100), "bsdf": {"type": "diffuse"}}
        simulator = mitsonar.Simulator(mi.load_dict({"type": "scene", "floor": floor}), mitsonar.Sonar(beams=16))
        pose = mitsonar.Pose.from_degrees([0, 0, 2.5, 35, 0, 0])
        print(simulator.tracer.film_echoes(pose, 0).range_m.sum(dtype=float))
        print(next(simulator.pings([pose])).levels.sum(dtype=float))
    """
    cuda, llvm = (
        [float(number) for number in run_python(script, MITSONAR_VARIANT=name).split()]
        for name in ("cuda_ad_mono", "llvm_ad_mono")
    )
    assert cuda == pytest.approx(llvm, rel=1e-5)


class _Launch:
    """Refuses once, as Dr.Jit does."""

    def __init__(self, message: str) -> None:
        self.message, self.calls = message, list[object]()

    def __call__(self, value: int) -> int:
        self.calls.append((value, gc.isenabled()))
        if "clear" not in self.calls:
            raise RuntimeError(self.message)
        return value + 1

    def clear(self) -> None:
        self.calls.append("clear")


def test_launch_that_cannot_be_replayed_is_recorded_anew() -> None:
    refused = _Launch("assign_with_registry(): The number of registry entries (3) did not match")
    assert replayed(refused, 4) == 5
    assert refused.calls == [(4, False), "clear", (4, False)]  # nothing is collected meanwhile
    assert gc.isenabled()
    broken = _Launch("out of memory")
    with pytest.raises(RuntimeError, match="out of memory"):
        replayed(broken, 4)
    assert broken.calls == [(4, False)]
