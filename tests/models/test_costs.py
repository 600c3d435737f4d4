"""Model files of strangers: what they may cost is bounded, and pipes are not opened."""

from __future__ import annotations

import os
import re
import struct
from pathlib import Path

import mujoco
import numpy as np
import pytest

from scm_world.backends import read_model
from scm_world.backends.mujoco import costs
from scm_world.backends.mujoco.costs import Costs
from scm_world.errors import ModelError, UnreadableFile

BODY = "<body><joint axis='0 1 0'/><geom size='.1'/></body>"


def scene(asset: str = "", body: str = BODY, more: str = "") -> str:
    """Return a model with an asset, bodies, and other sections."""
    return f"<mujoco>{more}<asset>{asset}</asset><worldbody>{body}</worldbody></mujoco>"


def repeated(count: str, body: str = BODY) -> str:
    """Return copies of a body."""
    return f"<replicate count='{count}' offset='1 0 0'>{body}</replicate>"


FLEX = "<flexcomp name='f' type='grid' count='2000 200 1' dim='2' spacing='1 1 1' mass='1'/>"
SENSOR = "<sensor><user dim='2000000000'/></sensor>"
CAMERA = "<camera name='c' resolution='60000 60000'/>"


@pytest.mark.parametrize(
    "text",
    [
        scene("<hfield name='h' nrow='60000' ncol='60000' size='1 1 1 1'/>"),
        scene("<texture name='t' type='2d' builtin='flat' width='60000' height='60000'/>"),
        scene("<texture name='t' type='cube' builtin='flat' width='9000' height='1'/>"),
        scene("<mesh name='m' builtin='supersphere' params='100000 1 1'/>"),
        scene("<mesh name='m' builtin='plate' params='10000 10000'/>"),
        scene(body=repeated("100000000")),
        scene(body=repeated("&#49;00000")),  # a reference to 1
        scene(body=repeated("1000", repeated("1000"))),
        scene(body=f"{BODY}<body name='x'>{FLEX}</body>"),
        scene(
            body=f"<body name='&lt;!--'>{repeated('100000')}<geom size='1' name='--&gt;'/></body>"
        ),
        scene(body=f"<body name='<!--'>{repeated('100000')}<geom size='1' name='-->'/></body>"),
        scene(more="<size nuserdata='2000000000'/>"),
        scene(more="<size nuser_geom='2000000000'/>"),
        scene(more="<size nkey='200000000'/>"),
        scene(more=SENSOR),
        scene(body=BODY + CAMERA),
    ],
)
def test_a_text_that_asks_for_too_much_is_refused(text: str) -> None:
    """Sizes of which memory or time would run out are one error that names both numbers."""
    with pytest.raises(ModelError, match=r"asks for [\d.e+]+ .*, more than [\d,]+; reduce it"):
        read_model(text)


def test_what_is_counted_is_what_mujoco_makes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Copies of included and attached files count as often as MuJoCo makes them, once each."""
    (tmp_path / "part.xml").write_text(f"<mujoco>{BODY * 3}</mujoco>")
    (tmp_path / "sub.xml").write_text(
        f"<mujoco><worldbody><body name='b'>{BODY * 4}</body></worldbody></mujoco>"
    )
    inner = repeated("5", "<include file='part.xml'/>")
    attached = "<frame><attach model='sub' body='b' prefix='p'/></frame>"
    text = scene("<model name='sub' file='sub.xml'/>", repeated("7", inner) + attached)
    path = tmp_path / "main.xml"
    path.write_text(text)
    mj = mujoco.MjSpec.from_file(str(path)).compile()
    made = mj.nbody - 1 + mj.njnt + mj.ngeom
    assert made == 7 * 5 * 9 + 4 * 3 + 1
    asked = Costs("", tmp_path).elements(text, tmp_path)
    assert made <= asked < made + 7 * 5 * 3  # with tags that make nothing
    monkeypatch.setattr(costs, "ELEMENTS", int(asked))
    assert read_model(path).bodies
    monkeypatch.setattr(costs, "ELEMENTS", int(asked) - 1)
    with pytest.raises(ModelError, match="elements"):
        read_model(path)


def test_tags_are_those_of_mujoco() -> None:
    """However a text is spelt, no element that MuJoCo makes of it is left out of the count."""
    generator = np.random.default_rng(0)
    bits = "<!-- --> <![CDATA[ ]]> <? ?> <! > < ' \" / /> name='a' = </x> <x> &lt; [ ] '> </ <\t"
    parts, read = [*bits.split(" "), " ", "\n"], 0
    for _ in range(3000):
        text = scene(body=repeated("7") + "<body name='q'><freejoint/><geom size='.1'/></body>")
        for _ in range(generator.integers(1, 3)):
            place = generator.integers(len(text))
            text = text[:place] + generator.choice(parts) + text[place:]
        try:
            mj = mujoco.MjSpec.from_string(text).compile()
        except ValueError:
            continue
        read += 1
        made = mj.nbody - 1 + mj.njnt + mj.ngeom
        assert Costs("", Path()).elements(text, Path()) >= made, text
    assert read > 100


def test_comments_ask_for_nothing() -> None:
    """What MuJoCo does not read does not count, and malformed text is left to its errors."""
    hidden = f"<!-- {repeated('100000000')} --><![CDATA[{repeated('100000000')}]]>"
    assert read_model(scene(body=BODY + hidden)).bodies
    with pytest.raises(ModelError, match="MuJoCo cannot read"):
        read_model(scene(body=BODY) + "<")


URDF = """<robot name="r"><link name="b"/><link name="l"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial><collision><geometry>
<mesh filename="meshes/a.stl"/></geometry></collision></link>
<joint name="j" type="continuous"><parent link="b"/><child link="l"/></joint></robot>"""


@pytest.mark.parametrize(
    "text",
    [
        scene("<mesh name='m' file='meshes/a' content_type='model/stl'/>"),
        scene("<mesh name='m' file='a.stl'/>", more="<compiler meshdir='meshes'/>"),
        scene(
            "<hfield name='h' file='a.bin' size='1 1 1 1'/>", more="<compiler assetdir='meshes'/>"
        ),
        scene("<texture name='t' type='cube' fileup='meshes/a'/>"),
        scene("<skin file='meshes/a'/>"),
        scene("<model name='m' file='meshes/a'/>"),
        scene(more="<include file='meshes/a'/>"),
        scene(more="<include file='outer.xml'/>"),
        scene(body=BODY + "<body name='f'><flexcomp name='f' type='mesh' file='meshes/a'/></body>"),
        URDF,
    ],
)
@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_only_regular_files_are_opened(tmp_path: Path, text: str, kind: str) -> None:
    """A pipe, a device or a folder in place of a file is refused by its name, and nothing waits."""
    (tmp_path / "meshes").mkdir()
    (tmp_path / "outer.xml").write_text("<mujoco><include file='meshes/a'/></mujoco>")
    for name in ("a", "a.stl", "a.bin"):
        path = tmp_path / "meshes" / name
        if kind == "pipe":
            os.mkfifo(path)
        elif kind == "device":
            path.symlink_to("/dev/zero")
        else:
            path.mkdir()
    main = tmp_path / ("main.urdf" if text is URDF else "main.xml")
    main.write_text(text)
    with pytest.raises(UnreadableFile, match=r"meshes/a.* not a regular file"):
        read_model(main)


@pytest.mark.parametrize(
    "asset",
    [
        "<texture name='t' type='2d' file='a.png'/>",
        "<hfield name='h' file='a.png' size='1 1 1 1'/>",
    ],
)
def test_a_picture_is_measured_before_it_is_unpacked(tmp_path: Path, asset: str) -> None:
    """A PNG of a few bytes that says it is 60,000 pixels wide and high is refused."""
    head = struct.pack(">I4sIIBBBBB", 13, b"IHDR", 60_000, 60_000, 8, 0, 0, 0, 0)
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + head)
    (tmp_path / "main.xml").write_text(scene(asset))
    with pytest.raises(ModelError, match=r"asks for 1\.44e\+10 numbers"):
        read_model(tmp_path / "main.xml")


def test_large_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file of more bytes than may be read is refused before it is opened."""
    (tmp_path / "a.stl").write_bytes(b"0" * 1001)
    (tmp_path / "main.xml").write_text(scene("<mesh name='m' file='a.stl'/>"))
    monkeypatch.setattr(costs, "BYTES", 1000)
    with pytest.raises(ModelError, match=r"1e\+03 bytes of .*a\.stl"):
        Costs("it", tmp_path).check(scene("<mesh name='m' file='a.stl'/>"))
    with pytest.raises(ModelError, match=r"bytes of .*a\.stl"):
        read_model(tmp_path / "a.stl")


def test_memory_that_there_is_not_is_said() -> None:
    """MuJoCo's own failures to allocate are errors of the model, too."""
    with pytest.raises(ModelError, match="more memory than there is"):
        read_model(scene(more="<size memory='900000T'/>"))


@pytest.mark.parametrize(
    "option", ["timestep='0'", "timestep='-1'", "timestep='nan'", "timestep='1e-300'"]
)
def test_a_step_has_a_length(option: str) -> None:
    """A physics step that is no time, or of which no control step would end, is refused."""
    with pytest.raises(ModelError, match="timestep"):
        read_model(scene(more=f"<option {option}/>"))


def test_solvers_end() -> None:
    """A solver that may go on for two billion iterations is refused."""
    with pytest.raises(ModelError, match="ls_iterations is 2000000000"):
        read_model(scene(more="<option ls_iterations='2000000000'/>"))


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("<joint name='j' damping='-1'/><geom size='.1'/>", r"j\.damping \(-1\)"),
        ("<joint name='j' stiffness='-5'/><geom size='.1'/>", r"j\.stiffness \(-5\)"),
        ("<joint name='j' armature='-1e-4'/><geom size='.1'/>", r"j\.armature \(-0\.0001\)"),
        ("<joint name='j' frictionloss='-1'/><geom size='.1'/>", r"j\.frictionloss \(-1\)"),
        ("<joint/><geom name='g' size='.1' friction='-1 0 0'/>", r"g\.friction \(-1\)"),
        ("<joint/><geom name='g' size='.1' solimp='.9 2 .1 .5 2'/>", r"g\.solimp \(0\.9 2"),
        ("<joint/><geom name='g' size='.1' margin='-1'/>", r"g\.margin \(-1\)"),
    ],
)
def test_values_outside_their_range_are_said_at_load(body: str, said: str) -> None:
    """A note names each quantity whose value in the file it cannot have, and its value."""
    plane = "<geom type='plane' size='1 1 1'/>"
    model = read_model(scene(body=f"{plane}<body pos='0 0 1'>{body}</body>"))
    (note,) = [note for note in model.notes if note.startswith("Outside the range")]
    assert re.search(said, note)
    usual = read_model(scene(body=plane + BODY))
    assert not [note for note in usual.notes if note.startswith("Outside the range")]


@pytest.mark.parametrize("value", ["nan", "inf"])
def test_values_are_finite(value: str) -> None:
    """A parameter of a file that is not a finite number is refused by name."""
    body = f"<body><joint name='j' damping='{value}'/><geom size='.1'/></body>"
    with pytest.raises(ModelError, match=r"not finite numbers: j\.damping"):
        read_model(scene(body=body))
