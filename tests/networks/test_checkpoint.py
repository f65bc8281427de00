"""Checkpoints: what is saved comes back, what a hostile or damaged file holds is refused in one sentence."""

from __future__ import annotations

import dataclasses
import io
import os
import pickle
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import TINY_TRAINING, tiny_network, tiny_recipe, tiny_samples

from mitsonar.errors import MitsonarError

torch = pytest.importorskip("torch", reason="torch is not installed: install mitsonar[learn]")
pytestmark = pytest.mark.learn


from mitsonar.datasets.samples import Samples  # noqa: E402
from mitsonar.networks.checkpoint import FILE, Checkpoint  # noqa: E402
from mitsonar.networks.corrnet import GaussianHead  # noqa: E402
from mitsonar.networks.create import create_network  # noqa: E402


@pytest.fixture(scope="module")
def checkpoint() -> Checkpoint:
    return Checkpoint.of(tiny_network(), tiny_samples(), **TINY_TRAINING)


def test_what_is_saved_comes_back(checkpoint: Checkpoint, tmp_path: Path) -> None:
    network = tiny_network().eval()
    checkpoint.save(tmp_path / FILE)
    state = torch.get_rng_state()
    for result in (Checkpoint.load(tmp_path), Checkpoint.load(tmp_path / FILE)):
        stored = {one.name: getattr(result, one.name) for one in dataclasses.fields(result) if one.name != "weights"}
        assert stored == {name: getattr(checkpoint, name) for name in stored}
        image = torch.rand(2, 1, 40, 24, generator=torch.Generator().manual_seed(1))
        assert torch.equal(result.build()(image), network(image))
        assert result.digest == checkpoint.digest
    assert torch.equal(torch.get_rng_state(), state), "building must not disturb what is drawn"
    assert Checkpoint.of(tiny_network(1), tiny_samples()).digest != checkpoint.digest
    assert not result.build().training
    assert list(tmp_path.iterdir()) == [tmp_path / FILE]


def test_it_says_what_it_was_trained_on(checkpoint: Checkpoint) -> None:
    assert checkpoint.arrangement == {
        "frames": 2,
        "views": ["image"],
        "kind": "image",
        "layout": "side",
        "coordinates": "polar",
        "cartesian_rows": 512,
        "ground": False,
        "range_levels": None,
        "halves": False,
    }
    assert checkpoint.trained_at == {"height_m": [2.5, 2.5], "pitch_deg": 35.0, "roll_deg": 0.0}
    assert (checkpoint.model, checkpoint.noise, checkpoint.data) == ("thesis", "low", "tiny")
    assert checkpoint.sonars["image"].beams == 12
    text = "\n".join(f"{name} {value}" for name, value in checkpoint.rows())
    for words in (
        "posenet",
        "12 beams, 40 bins",
        "noise low",
        "height 2.5 m, pitch 35 deg",
        "pairs 1,200",
        "6 mm / 2 mm / 0.2 deg",
    ):
        assert words in text
    both = Checkpoint.of(
        create_network("posenet_dual", width=1 / 16, size=(40, 24), cartesian_size=(32, 40)),
        tiny_samples(coordinates="both", cartesian_rows=32),
    )
    assert (both.arrangement["coordinates"], both.arrangement["cartesian_rows"]) == ("both", 32)
    raised = Checkpoint.of(
        tiny_network(), Samples(tiny_recipe(mount={"up_m": 0.5, "pitch_deg": 20, "roll_deg": 3}, flight__height_m=[1, 4]))
    )
    assert raised.fixed == "height 1.5..4.5 m, pitch 20 deg, roll 3 deg"


def test_answers_become_motions(checkpoint: Checkpoint) -> None:
    """Labels of +-10 are the limits of the flight; distributions are in SI; errors in validation give a covariance."""
    motions, spread = checkpoint.decode(torch.tensor([[10.0, -10.0, 5.0]]))
    assert np.allclose(motions, [[0.02, -0.02, np.radians(0.225)]])
    assert spread is None
    output = GaussianHead(torch.full((2, 3), 0.25), torch.eye(3).expand(2, 3, 3))
    motions, spread = checkpoint.decode(output)
    assert motions.shape == (2, 3)
    assert spread is not None
    assert (spread == np.eye(3)).all()
    # the noise of training was not validated: the mean over the levels that were
    expected = np.diag([(3e-3**2 + 6e-3**2) / 2, 2e-3**2, np.radians(1) ** 2 * (0.1**2 + 0.2**2) / 2])
    covariance = checkpoint.covariance
    assert covariance is not None
    assert np.allclose(covariance, expected, rtol=1e-12, atol=0)
    at_home = dataclasses.replace(checkpoint, noise="high").covariance
    assert at_home is not None
    assert np.allclose(np.sqrt(np.diag(at_home)), [6e-3, 2e-3, np.radians(0.2)])
    assert dataclasses.replace(checkpoint, metrics={}).covariance is None


def test_only_our_networks_and_plain_values(checkpoint: Checkpoint) -> None:
    with pytest.raises(MitsonarError, match="one of our networks: got Linear"):
        Checkpoint.of(torch.nn.Linear(2, 3), tiny_samples())
    with pytest.raises(MitsonarError, match="only numbers, strings, lists and dictionaries"):
        Checkpoint.of(tiny_network(), tiny_samples(), trained={"when": object()})
    stored = Checkpoint.of(
        tiny_network(), tiny_samples(), trained={"rate": np.float32(0.5), "folder": Path("a") / "b", "steps": (1, 2)}
    )
    assert stored.trained == {"rate": 0.5, "folder": "a/b", "steps": [1, 2]}


# ---------------------------------------------------------------- hostile files


def pack_responses(table: object) -> bytes:
    buffer = io.BytesIO()
    torch.save(table, buffer)
    return buffer.getvalue()


def unpacked(checkpoint: Checkpoint) -> dict[str, Any]:
    return dict(torch.load(io.BytesIO(checkpoint.to_bytes()), weights_only=True))


def refusal(content: bytes) -> str:
    with pytest.raises(MitsonarError) as error:
        Checkpoint.from_bytes(content, "that.ckpt").build()
    return str(error.value)


class Evil:
    """Unpickled, it makes a folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return os.mkdir, (str(self.path),)


def test_nothing_in_a_file_is_executed(checkpoint: Checkpoint, tmp_path: Path) -> None:
    trap = tmp_path / "sprung"
    contents = [
        pack_responses(Evil(trap)),
        pack_responses({**unpacked(checkpoint), "trained": Evil(trap)}),
        pickle.dumps(Evil(trap)),
    ]
    for content in contents:
        assert "that.ckpt" in refusal(content)
    assert not trap.exists()
    with zipfile.ZipFile(io.BytesIO(contents[0])) as parts:  # the trap is a real one
        pickle.loads(next(parts.read(name) for name in parts.namelist() if name.endswith("data.pkl")))
    assert trap.exists()


def test_files_that_are_no_checkpoints(checkpoint: Checkpoint, tmp_path: Path) -> None:
    whole = checkpoint.to_bytes()
    assert "that.ckpt" in refusal(b"")
    assert "cut off" in refusal(b"not a zip at all")
    for end in (100, len(whole) // 2, len(whole) - 10):
        assert "cut off" in refusal(whole[:end])
    at = whole.index(checkpoint.weights["regression.weight"].numpy().tobytes())
    assert "checksum" in refusal(whole[: at + 5] + bytes([whole[at + 5] ^ 1]) + whole[at + 6 :])
    assert "something else" in refusal(pack_responses({"state": torch.zeros(3)}))
    assert "something else" in refusal(pack_responses([1, 2]))
    assert "that.ckpt is damaged" in refusal(pack_responses(torch.nn.Linear(1, 1)))
    assert "--resume" in refusal(pack_responses({"pytorch-lightning_version": "2.6", "state_dict": {}}))
    locator = b"PK\x06\x07" + struct.pack("<LQL", 0, 0, 2)  # the end's place, on the first of two disks
    assert "that.ckpt" in refusal(whole[:-22] + locator + whole[-22:])
    foreign = io.BytesIO()
    with zipfile.ZipFile(foreign, "w") as parts:
        parts.writestr("data.pkl", b"\x80\x02K\x01.")
    assert "that.ckpt" in refusal(foreign.getvalue())
    with pytest.raises(MitsonarError, match="no checkpoint"):
        Checkpoint.load(tmp_path / "absent.ckpt")
    with pytest.raises(MitsonarError, match=f"holds no {FILE}"):
        Checkpoint.load(tmp_path)


def test_a_later_format_is_named(checkpoint: Checkpoint) -> None:
    output = refusal(pack_responses({**unpacked(checkpoint), "format": 7, "version": "3.2.1", "news": 1}))
    assert "format 7" in output
    assert "mitsonar 3.2.1" in output
    assert "use the version that wrote it" in output


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"trained_at": None}, "trained_at: input should be a valid dictionary"),
        (
            {"trained_at": {"height_m": [1.0], "pitch_deg": 0, "roll_deg": 0}},
            "trained_at.height_m: list should have",
        ),
        ({"network": 3}, "network: input should be a valid string, got 3"),
        ({"more": 1}, "unknown checkpoint key more"),
        ({"weights": {"a": [1, 2]}}, "weights.a: input should be an instance of Tensor"),
        ({"weights": {"a": torch.tensor([1.0, float("nan")])}}, "nan or inf"),
        ({"options": {1: 2}}, "options.1.[key]: input should be a valid string"),
        ({"arrangement": {"frames": 2}}, "lacks arrangement.views"),
        ({"labels": {"kind": "octal"}}, "labels.kind: input should be 'raw', 'quantised' or 'normx10', got 'octal'"),
        (
            {"labels": {"kind": "raw", "low": [0], "high": [1], "names": []}},
            "labels.names: list should have",
        ),
        (
            {"labels": {"kind": "raw", "low": [0], "high": [float("inf")], "names": ["a"]}},
            "labels.high.0: input should",
        ),
        ({"sonar": {"image": {"beams": -4}}}, "sonar image: sonar beams"),
        ({"sonar": {"image": 4}}, "sonar.image: input should be a valid dictionary, got 4"),
    ],
)
def test_fields_are_checked(checkpoint: Checkpoint, change: dict[str, Any], words: str) -> None:
    assert words in refusal(pack_responses({**unpacked(checkpoint), **change}))


@pytest.mark.parametrize("change", ["format", "version", "options", "width", "size", "labels", "sonar", "more"])
def test_long_words_are_cut(checkpoint: Checkpoint, change: str) -> None:
    """A refusal repeated a stranger's word whole."""
    long, table = "long" * 2000, unpacked(checkpoint)
    match change:
        case "format":
            table |= {"format": long, "version": long}
        case "version":
            table |= {"version": long, "options": {**table["options"], "width": -1}}
        case "options":
            table["options"] = {**table["options"], long: 1}
        case "width" | "size":
            table["options"] = {**table["options"], change: long}
        case "labels":
            table["labels"] = {**table["labels"], "kind": long}
        case "sonar":
            table["sonar"] = {long: 1}
        case _:
            table[long] = 1
    with pytest.raises(MitsonarError) as caught:
        Checkpoint.from_bytes(pack_responses(table)).build()
    assert len(str(caught.value)) < 1000


def test_fields_that_lack(checkpoint: Checkpoint) -> None:
    table = unpacked(checkpoint)
    for name in ("weights", "labels", "data_recipe"):
        assert f"checkpoint lacks {name}" in refusal(
            pack_responses({key: value for key, value in table.items() if key != name})
        )


def test_weights_and_options_must_fit_the_network(checkpoint: Checkpoint) -> None:
    table = unpacked(checkpoint)
    assert "unknown network 'posenot': did you mean posenet" in refusal(pack_responses({**table, "network": "posenot"}))
    assert "unknown option 'depth'" in refusal(pack_responses({**table, "options": {"depth": 4}}))
    assert "do not fit a posenet" in refusal(pack_responses({**table, "options": {**table["options"], "width": 1 / 8}}))
    assert "do not fit a posenet" in refusal(pack_responses({**table, "weights": {}}))
    less = {name: values for name, values in table["weights"].items() if name != "regression.bias"}
    assert "regression.bias" in refusal(pack_responses({**table, "weights": less}))
    assert "no posenet has these options" in refusal(
        pack_responses({**table, "options": {**table["options"], "width": 1e30}})
    )


def test_files_of_before_vectors_had_words_are_read(checkpoint: Checkpoint) -> None:
    """Words that came later may be missing; one that is there must be what it should."""
    words = {key: value for key, value in checkpoint.arrangement.items() if key not in ("range_levels", "halves")}
    older = Checkpoint.from_bytes(dataclasses.replace(checkpoint, arrangement=words).to_bytes())
    assert older.arrangement == words
    wrong = dataclasses.replace(checkpoint, arrangement={**words, "halves": 3})
    with pytest.raises(MitsonarError, match=r"arrangement\.halves: input should be a valid boolean, got 3"):
        Checkpoint.from_bytes(wrong.to_bytes())
