"""Plugins work from XML in whichever order variant and imports come, and after the variant has changed."""

from __future__ import annotations

import ast
import re
import textwrap
from pathlib import Path

import pytest
from helpers import essence, run_python

from mitsonar.plugins import PLUGINS
from mitsonar.plugins.scalar_variants import KINDS

SHIPPED = {
    "imaging_sonar": "imaging_sonar_sensor",
    "channel_sonar": "channel_sonar_sensor",
    "echo": "echo_integrator",
    "acoustic_material": "acoustic_material",
    "cell_noise": "cell_noise",
    "perlin": "perlin",
}
"""Plugins by their name in XML, and their files."""

NEEDED = {"acoustic_material": {"material": "sand"}}
"""Properties without a default."""

SCENE = """
    XML = '''<scene version="3.0.0">
        <integrator type="echo"/>
        <sensor type="imaging_sonar">
            <integer name="beams" value="3"/> <integer name="rays_per_beam" value="5"/>
            <transform name="to_world"><lookat origin="0, 0, 2.5" target="0, 3.57, 0" up="0, 0, 1"/></transform>
        </sensor>
        <shape type="rectangle">
            <transform name="to_world"><scale value="100"/></transform>
            <bsdf type="diffuse"><texture type="cell_noise" name="reflectance"/></bsdf>
        </shape>
        <shape type="sphere">
            <point name="center" x="0" y="4" z="0"/> <float name="radius" value="0.4"/>
            <bsdf type="acoustic_material">
                <string name="material" value="steel"/> <texture type="perlin" name="reflectance"/>
            </bsdf>
        </shape>
    </scene>'''

    def channels(scene=None):
        import mitsuba as mi, numpy as np
        scene = scene or mi.load_string(XML, parallel=False)
        image = np.array(mi.render(scene))
        assert image.shape[:2] == (5, 12)
        picked = image[:, :, -len(scene.integrator().aov_names()):]
        assert (picked[:, :, 0] == 1).all() and set(np.unique(picked[:, :, -1])) <= {0, 1}
        return picked
"""

ORDERS = {
    "mitsonar, mitsuba, variant": """
        import mitsonar
        import mitsuba as mi
        mi.set_variant("llvm_ad_mono")
        channels()
    """,
    "mitsuba, variant, mitsonar": """
        import mitsuba as mi
        mi.set_variant("llvm_ad_mono")
        import mitsonar
        channels()
    """,
    "mitsuba, mitsonar, variant": """
        import mitsuba as mi
        import mitsonar
        mi.set_variant("llvm_ad_mono")
        channels()
    """,
    "variant changed twice": """
        import mitsonar
        import mitsuba as mi
        import numpy as np
        mi.set_variant("llvm_ad_mono")
        first = channels()
        mi.set_variant("llvm_ad_rgb")
        colour = channels()
        mi.set_variant("llvm_ad_mono")
        np.testing.assert_array_equal(channels(), first)
        np.testing.assert_allclose(colour, first, atol=1e-6)
    """,
    "mitsuba's submodules first": """
        import mitsonar
        from mitsuba.llvm_ad_mono import Float
        import mitsuba as mi
        mi.set_variant("llvm_ad_mono")
        channels()
    """,
    "scalar variant between": """
        import mitsonar
        import mitsuba as mi
        mi.set_variant("scalar_rgb")
        mi.render(mi.load_dict({"type": "scene", "i": {"type": "direct"}, "s": {"type": "sphere"},
                                "c": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}}}), spp=1)
        mi.set_variant("llvm_ad_mono")
        channels()
    """,
}


KEPT = """
    import mitsonar
    import mitsuba as mi
    import numpy as np
    mi.set_variant("llvm_ad_mono")
    scene = mi.load_string(XML, parallel=False)
    first = channels(scene)
    mi.set_variant("llvm_ad_rgb")
    mi.set_variant("llvm_ad_mono")
    from mitsonar.simulation.scene import sonar_in
    assert sonar_in(scene) is not None, "the scene's sonar is not found any more"
    names = scene.integrator().aov_names()
    again = channels(scene)
    changed = [name for k, name in enumerate(names) if not np.array_equal(again[..., k], first[..., k])]
    assert not changed, f"other values in {changed}"
"""


@pytest.mark.thorough
@pytest.mark.parametrize("order", essence(ORDERS, "mitsuba, variant, mitsonar", rest=pytest.mark.slow))
def test_order_of_imports_and_variants(order: str) -> None:
    run_python(textwrap.dedent(SCENE) + textwrap.dedent(ORDERS[order]))


@pytest.mark.thorough
def test_a_scene_outlives_a_change_of_variant_and_back() -> None:
    """A scene loaded before still renders the same, and its sonar is still found."""
    run_python(textwrap.dedent(SCENE) + textwrap.dedent(KEPT))


def snippet(name: str) -> str:
    """The XML in the docstring of a plugin's class."""
    import importlib.util

    spec = importlib.util.find_spec("mitsonar.plugins")
    assert spec is not None
    assert spec.submodule_search_locations is not None
    with open(f"{spec.submodule_search_locations[0]}/{SHIPPED[name]}.py", encoding="utf-8") as file:
        tree = ast.parse(file.read())
    assert (ast.get_docstring(tree) or "").startswith(("The sensor", "The integrator", "The texture", "The BSDF"))
    docs = [ast.get_docstring(node) or "" for node in tree.body if isinstance(node, ast.ClassDef)]
    result = re.findall(r"\.\. code-block:: xml\n\n((?:    .*\n?|\n)+)", "\n".join(docs))
    assert len(result) == 1, f"{name} needs one scene snippet in its docstring"
    return textwrap.dedent(result[0])


def test_every_module_that_registers_is_known() -> None:
    assert set(SHIPPED.values()) <= set(PLUGINS)


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("name", SHIPPED)
def test_snippet_of_the_docstring_loads(name: str) -> None:
    import mitsuba as mi

    text = snippet(name)
    assert f'type="{name}"' in text
    if text.startswith("<texture"):
        text = f'<shape type="sphere"><bsdf type="diffuse">{text}</bsdf></shape>'
    if text.startswith("<bsdf"):
        text = f'<shape type="sphere">{text}</shape>'
    scene = mi.load_string(f'<scene version="3.0.0">{text}</scene>', parallel=False)
    assert isinstance(scene, mi.Scene)
    if name == "imaging_sonar":
        assert type(scene.sensors()[0]).__name__ == "ImagingSonar"
    elif name == "echo":
        assert type(scene.integrator()).__name__ == "Echo"


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("name", SHIPPED)
def test_a_typing_slip_is_an_error(name: str) -> None:
    import mitsuba as mi

    with pytest.raises(RuntimeError, match=r"sead"):
        mi.load_dict({"type": name, **NEEDED.get(name, {}), "sead": 3})


@pytest.mark.thorough
def test_asking_whether_mitsuba_is_there_does_not_lose_the_plugins() -> None:
    run_python("""
        import importlib.util, mitsonar
        assert importlib.util.find_spec("mitsuba") is not None
        mitsonar.load_scene("flat_floor")
    """)


def test_every_plugin_is_known_by_its_kind() -> None:
    """Scalar variants refuse the plugins by these names."""
    import importlib.util

    spec = importlib.util.find_spec("mitsonar.plugins")
    assert spec is not None
    assert spec.submodule_search_locations is not None
    texts = [path.read_text() for path in Path(spec.submodule_search_locations[0]).glob("*.py")]
    result = {pair for text in texts for pair in re.findall(r'^mi\.register_(\w+)\("(\w+)"', text, flags=re.MULTILINE)}
    assert result == {(kind, name) for kind, names in KINDS.items() for name in names}


@pytest.mark.thorough
def test_scalar_variants_name_the_variant_that_is_needed() -> None:
    """In Mitsuba's own loader, for each plugin; in load_scene, which leaves the user's variant as it is."""
    output = run_python("""
        import mitsonar
        import mitsuba as mi
        from mitsonar.plugins.scalar_variants import KINDS
        mi.set_variant("scalar_rgb")
        for name in (name for names in KINDS.values() for name in names):
            try:
                mi.load_dict({"type": name})
            except RuntimeError as error:
                assert f"{name} is a plugin of mitsonar" in str(error), error
                assert 'variant scalar_rgb: call mi.set_variant("llvm_ad_mono")' in str(error), error
            else:
                raise AssertionError(name)
        try:
            mitsonar.load_scene("flat_floor")
        except mitsonar.MitsonarError as error:
            print(error)
        assert mi.variant() == "scalar_rgb"
        mi.set_variant("llvm_ad_mono")
        mitsonar.load_scene("flat_floor")
    """)
    assert "the Mitsuba variant scalar_rgb is set" in output
    assert "mi.set_variant(" in output


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("name", ["max_depth", "rr_depth", "hide_emitters"])
def test_echo_has_no_properties_not_those_of_its_base_either(name: str) -> None:
    import mitsuba as mi

    with pytest.raises(RuntimeError, match=rf"the integrator echo has no properties: got {name}"):
        mi.load_dict({"type": "echo", name: False if name == "hide_emitters" else 2})
