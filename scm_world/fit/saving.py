"""What a fit writes: the user's own model file with other numbers, values as YAML, a page."""

from __future__ import annotations

import base64
import html
import re
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scm_world._arguments import load
from scm_world._types import Floats
from scm_world.errors import ModelError, ScmWorldError, UnknownOption
from scm_world.fit.inertia import AXES, PARTS
from scm_world.fit.targets import LATE, twin_of, values_of
from scm_world.runs.canvas import png
from scm_world.runs.files import write_whole
from scm_world.tasks.model import ModelTask

if TYPE_CHECKING:
    from scm_world.fit.result import Fit

CLOSE = 1e-9  # largest relative difference of a number that was written and read again
DRIVEN = ("gear", "kp", "kv", "gain", "bias", "forcerange", "ctrlrange", "timeconst")
GENERAL = ("kp", "kv", "gain", "bias", "timeconst")  # what arrays of <general> have in MJCF
STYLE = "body{font:16px/1.5 sans-serif;max-width:60em;margin:2em auto;padding:0 1em}"
STYLE += "table{border-collapse:collapse}td,th{padding:.2em .8em;text-align:right}img{width:100%}"
OTHER = r"<!--.*?-->|<(sensor|equality|keyframe)\b[^>/]*>.*?</\1>|<(?:site|camera|light)\b[^>]*>"
MJCF = {"inertia": "diaginertia", "center_of_mass": "pos", "principal_axes": "quat"}
MJCF["anchor"] = "pos"  # other names there
TURNED = r"\s*\b(?:fullinertia|axisangle|euler|xyaxes|zaxis)\s*=\s*([\"']).*?\1"
ANGLES = ("range", "ref", "springref")  # of hinges, in degrees unless the compiler says radians
INSIDE = {"mass": ("mass", "value"), "damping": ("dynamics", "damping")}
INSIDE["frictionloss"] = ("dynamics", "friction")  # of URDF: a child and its attribute


def saved(fit: Fit, path: Path) -> None:
    """Write a fit as the ending of the file says; see ``Fit.save``."""
    kind = path.suffix.lower()
    if kind in (".yaml", ".yml"):
        write_whole(path, as_yaml(fit))
    elif kind == ".html":
        write_whole(path, as_page(fit))
    elif kind in (".xml", ".mjcf", ".urdf"):
        _save_model(fit, path)
    else:
        allowed = (".xml or .urdf: the model", ".yaml: the values", ".html: a page")
        raise UnknownOption("ending of the file", kind or path.name, allowed)


def as_yaml(fit: Fit) -> str:
    """Return values with their intervals, what was read, the replay and the remarks as YAML."""
    yaml = load("yaml", "pyyaml")
    table = fit.table.set_index("parameter").astype(object)
    values = {name: row.to_dict() for name, row in table.iterrows()}
    parts = {"recording": fit.read, "values": values, "remarks": [*fit.remarks]}
    parts["replay"] = fit.replay.set_index("column").to_dict("index")
    return str(yaml.safe_dump(parts, sort_keys=False, allow_unicode=True))


def as_page(fit: Fit) -> str:
    """Return a page with intervals, remarks, replay, traces and residuals, in one file."""
    picture = base64.b64encode(png(fit.picture())).decode()
    tables = [("Values with 95 % intervals", fit.table), ("Combinations", fit.identifiable)]
    tables.append(("Played from the first row, root mean square of the error", fit.replay))
    if fit.held_out is not None:
        tables.append(("Held out", fit.held_out.table))
    found = [f"<h2>{title}</h2>{frame.to_html(index=False, border=0)}" for title, frame in tables]
    said = "".join(f"<li>{html.escape(remark)}</li>" for remark in fit.remarks)
    traces = f"<h2>Measured and fitted</h2><img alt='traces' src='data:image/png;base64,{picture}'>"
    body = f"<h1>Fit</h1><p>{html.escape(fit.read)}</p><ul>{said}</ul>{''.join(found)}{traces}"
    head = f"<meta charset='utf-8'><title>Fit</title><style>{STYLE}</style>"
    return f"<!doctype html><html lang='en'><head>{head}</head><body>{body}</body></html>"


def _save_model(fit: Fit, path: Path) -> None:
    """Write the file that the world was made from, with the fitted numbers; read it to check."""
    build, (kind, task, options, _), *_ = fit.asked.__reduce__()
    source = task.given.get("model", "") if isinstance(task, ModelTask) else ""
    if not isinstance(source, str | Path) or not str(source):
        raise ModelError(["the world was not made from a model file: save values as .yaml"])
    whole = str(source).lstrip().startswith("<")
    before = str(source) if whole else Path(source).read_text("utf-8")
    after, trial = before, path.with_name(f"{uuid.uuid4().hex}{path.suffix}")
    with twin_of(fit.asked) as twin:
        names = [n for n in twin.compiled.static_names if not n.endswith(LATE)]
        given = {n: np.array(twin[n]) for n in fit.asked.plan.at_start() if n in names}
        fitted = values_of(fit.targets, fit.scaled)
        values = given | {n: value for n, value in fitted.items() if not n.endswith(LATE)}
        if tied := [name for name in values if name in {tie.name for tie in task.ties}]:
            said = f"{', '.join(tied)} are variables of ties=, which a model file does not have"
            raise ModelError([f"{said}: save values as .yaml, or fit the parameters they decide"])
        wanted = {name: np.array(values.get(name, twin[name])) for name in names}
        units = {name: twin.model.declared(name).unit for name in values}
        system: Any = twin.composition.system
        mj = system.source.realized
    for name in values:
        after = _with(after, name, wanted, mj, units[name])
    try:
        write_whole(trial, after)
        about = {**task.given, "model": str(trial)}
        with build(kind, type(task)(**about), options, None) as world:
            world.reset(seed=0)
            read = {name: np.array(world[name]) for name in names if name in world.model}
    except ScmWorldError as error:
        advice = "save it beside the original, if it names other files, or save values as .yaml"
        raise ModelError([f"{path.name} cannot be read again: {error}; {advice}"]) from error
    finally:
        trial.unlink(missing_ok=True)
    lost = [
        name
        for name, value in wanted.items()
        if name not in read or not np.allclose(read[name], value, rtol=CLOSE, atol=1e-300)
    ]
    if lost:
        problem = f"{', '.join(lost)} cannot be written in this file: elements with their names do "
        problem += "not have these attributes, but a default class, an included file or another one"
        raise ModelError([f"{problem}; save values as .yaml, or name and write the elements there"])
    write_whole(path, after)


def _with(text: str, name: str, values: Mapping[str, Floats], mj: Any, unit: str) -> str:
    """Return the text of a model with other numbers of one parameter; as it is if it cannot be."""
    element, _, attribute = name.rpartition(".")
    hidden = re.sub(OTHER, lambda found: " " * len(found[0]), text, flags=re.S)
    tags = _tags(hidden, element, attribute)
    root = re.search(r"<mujoco\b[^>]*>", hidden)
    if not tags and not element and root:
        option = f'<option {attribute}="{_written(values[name])}"/>'
        return f"{text[: root.end()]}{option}{text[root.end() :]}"
    if not tags:
        return text
    tag = tags[0]
    if re.search(r"<robot\b", hidden) and attribute in INSIDE:
        child, attribute = INSIDE[attribute]
        last = hidden.find("</" + tag[1], tag.end())
        inner = re.compile(rf"<{child}\b[^>]*>").search(hidden, tag.end(), last)
        if inner is None:
            child = f'<{child} {attribute}="{_written(values[name])}"/>'
            return f"{text[: tag.end()]}{child}{text[tag.end() :]}"
        tag = inner
    elif attribute in PARTS and tag[1] == "body":
        inner = re.compile(r"<inertial\b[^>]*>|</?body\b").search(hidden, tag.end())
        about = mj.body(element)
        if inner is None or not inner[0].startswith("<inertial"):
            parts = {"pos": about.ipos, "quat": about.iquat, "mass": about.mass}
            parts["diaginertia"] = about.inertia
            for part in PARTS:
                if (value := values.get(f"{element}.{part}")) is not None:
                    parts[MJCF.get(part, part)] = value if part != AXES else np.roll(value, 1)
            words = " ".join(f'{key}="{_written(numbers)}"' for key, numbers in parts.items())
            return f"{text[: tag.end()]}<inertial {words}/>{text[tag.end() :]}"
        tag = inner
    first, last = tag.span()
    changed, value = text[first:last], values[name]
    if attribute == AXES or (attribute == "inertia" and re.search(r"\bfullinertia\s*=", changed)):
        about = mj.body(element)  # moments and axes together replace what else says them
        changed = re.sub(TURNED, "", changed, flags=re.S)
        axes = np.roll(values.get(f"{element}.{AXES}", np.roll(about.iquat, -1)), 1)
        changed = _replaced(changed, MJCF[AXES], axes)
        value, attribute = values.get(f"{element}.inertia", about.inertia), "inertia"
    if changed.startswith("<general") and attribute in GENERAL:
        for array, numbers in _general(element, values, mj).items():
            changed = _replaced(changed, array, numbers)
        return text[:first] + changed + text[last:]
    degrees = re.search(r"<compiler\b[^>]*\bangle\s*=\s*[\"']radian", hidden) is None
    if changed.startswith("<joint") and root and degrees and attribute in ANGLES and unit == "rad":
        value = np.rad2deg(value)
    changed = _replaced(changed, MJCF.get(attribute, attribute), value)
    return text[:first] + changed + text[last:]


def _general(element: str, values: Mapping[str, Floats], mj: Any) -> dict[str, Floats]:
    """Return arrays of a ``<general>`` actuator that its gains, bias and time constants decide.

    Source:
        MuJoCo, *XML reference*, actuator/position and actuator/velocity: their gains and biases.
    """
    about = mj.actuator(element)
    gain, bias = about.gainprm[:3].copy(), about.biasprm[:3].copy()
    given = {name: values.get(f"{element}.{name}") for name in GENERAL}
    kp, kv = given["kp"], given["kv"]
    if kp is not None:
        gain[0], bias[1] = kp, -kp
    elif kv is not None:
        gain[0] = kv
    if kv is not None:
        bias[2] = -kv
    gain[0] = gain[0] if given["gain"] is None else given["gain"]
    bias = bias if given["bias"] is None else np.asarray(given["bias"])
    found = {"gainprm": gain[:1], "biasprm": bias}
    return found if given["timeconst"] is None else found | {"dynprm": given["timeconst"]}


def _tags(hidden: str, element: str, attribute: str) -> list[re.Match[str]]:
    """Return the tags that may define a parameter: of a body, a joint, an actuator, a geometry."""
    if not element:
        return [*re.finditer(r"<(option)\b[^>]*>", hidden)]
    named = re.compile(rf"<(\w+)\b[^>]*?\bname\s*=\s*[\"']{re.escape(element)}[\"'][^>]*>")
    found = [*named.finditer(hidden)]
    bodies = [tag for tag in found if tag[1] in ("body", "link")]
    if attribute in PARTS:
        return bodies
    others = (tag for tag in found if tag not in bodies)
    return [tag for tag in others if (tag[1] in ("joint", "geom")) != (attribute in DRIVEN)]


def _replaced(tag: str, attribute: str, value: Floats) -> str:
    """Return a tag with another value of an attribute; numbers that follow it stay."""
    numbers = _written(value)
    there = re.search(rf"(\b{attribute}\s*=\s*)([\"'])(.*?)\2", tag)
    if there is None:
        end = tag.rindex("/>") if tag.endswith("/>") else len(tag) - 1
        return f'{tag[:end].rstrip()} {attribute}="{numbers}"{tag[end:]}'
    more = there[3].split()[np.size(value) :]
    return tag[: there.start(3)] + " ".join([numbers, *more]) + tag[there.end(3) :]


def _written(value: Floats) -> str:
    return " ".join(repr(float(number)) for number in np.ravel(value))
