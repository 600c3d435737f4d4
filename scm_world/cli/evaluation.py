"""The commands that score policies and explain scores: ``evaluate`` and ``explain``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from scm_world._arguments import one_of
from scm_world.cli import console, options
from scm_world.cli.arguments import load_system, parse_assignments
from scm_world.errors import UnknownOption


def evaluate(
    policy: Annotated[str, typer.Argument(metavar="POLICY")],
    task: Annotated[str | None, typer.Argument(metavar="SYSTEM")] = None,
    *,
    protocols: options.Text = None,
    n: options.N = 200,
    seeds: str = "0",
    backend: options.Text = None,
    env: options.Pairs = None,
    option: options.Pairs = None,
    metric: options.Text = None,
    trust: options.Words = None,
    out: options.Out = None,
    jobs: options.ManyJobs,
) -> None:
    """Score policies in protocols, with 95 % intervals.

    Writes results.json, a table of all episodes, and plots. After Ctrl-C (exit code 130) the same
    command resumes.
    Example: scm-world evaluate zoo:pushing,random --protocols P0,P5 -n 100

    Args:
        policy: A file (.safetensors, .zip; a .zip of Stable-Baselines3 with
            --trust stable_baselines3), the folder of a training run,
            zoo:NAME, random, still, sweep, feedback, or module:function; several with commas;
            NAME=POLICY names one, and A+B are its runs.
        task: A task (see 'scm-world list'), a model.xml or model.urdf, or module:function; by
            default what the policy was trained for, or pushing.
        protocols: Names with commas, such as P0,P5; all of the task by default. P2@100 intervenes
            within episodes, from control step 100 on.
        n: Episodes of each protocol, for each seed.
        seeds: Seeds of the draws and of all other noise, with commas.
        backend: Physics backend: mujoco, bullet, step, fake or trifinger_platform; or two with a
            comma, compared. That of the task by default.
        env: Option of the environment, such as frame_skip=3.
        metric: Score that is shown and drawn; all are written. By default
            last_fractional_success, or return where a task has none.
    """
    import pandas

    from scm_world import evaluation
    from scm_world.evaluation import METRICS
    from scm_world.evaluation.figures import write_figures
    from scm_world.evaluation.preparation import task_of

    sys.path.insert(0, str(Path.cwd()))  # for modules of the working directory
    one_of("metric", metric, (None, *METRICS))
    agents = policies_of(policy)
    task = task or task_of(agents)
    made = load_system(task, option, is_task=True)
    settings = parse_assignments(env, "'--env'")
    if option:
        settings["task_options"] = dict(made.given)
    words = *agents, task, *(option or ()), *(env or ())
    folder = console.results_folder(out, "evaluate", *words)
    named = (text.partition(":")[0] for runs in agents.values() for text in runs if ":" in text)
    trusted = (*trust, *(name.partition(".")[0] for name in named)) if trust else None
    with jobs.open("episodes", folder, "parts/*.json", "files") as job:
        found = evaluation.evaluate(
            agents,
            protocols,
            task=task,
            n=n,
            seeds=seeds,
            backend=backend or made.backend,
            env=settings,
            trusted=trusted,
            **job,
        )
    metric = metric or next(name for name in METRICS if name in found.metrics)
    files = *found.save(folder), *write_figures(found, folder, metric)

    docs = {one["name"]: one.get("doc", "") for one in found.about["protocols"]}
    engines = found.engines
    rows, gaps = [], []
    for name in found.protocols:
        scores = {
            agent if len(engines) == 1 else f"{agent}, {engine}": found.score(
                name, metric, agent=agent, engine=engine
            )
            for agent in found.agents
            for engine in engines
        }
        rows.append({"protocol": name, "varied": docs.get(name, ""), **scores})
        if len(engines) == 2:
            apart = {a: found.difference(*engines, name, metric, agent=a) for a in found.agents}
            gaps.append({"protocol": name, **apart})
    title = f"{metric.replace('_', ' ')} in {found.task}, with 95 % intervals"
    console.frame(pandas.DataFrame(rows), title=title)
    if gaps:
        title = f"{' minus '.join(engines)}, the same draws on both"
        console.frame(pandas.DataFrame(gaps), title=title)
    console.written(*files)


def policies_of(text: str) -> dict[str, list[str]]:
    """Return the runs of each policy: ``NAME=POLICY`` or ``POLICY``, with commas; ``A+B`` are runs.

    Example:
        >>> policies_of("mine=a.zip+b.zip,random")
        {'mine': ['a.zip', 'b.zip'], 'random': ['random']}
    """
    from scm_world.policies.agents import NAMES

    found: dict[str, list[str]] = {}
    for word in (part.strip() for part in text.split(",")):
        name, equals, given = (part.strip() for part in word.partition("="))
        is_path = word not in NAMES and Path(word).exists()  # which may have any letters
        runs = [word] if is_path else (given if equals else word).split("+")
        if not equals or is_path:
            path = Path(runs[0])
            if path.is_dir():
                name = path.resolve().name
            else:
                name = runs[0].replace(":", ".") if ":" in runs[0] else path.stem
        if not word or not all(runs) or not name or name in found:
            allowed = ("names or files, each once; NAME=POLICY gives a name",)
            raise UnknownOption("policy", text, allowed)
        found[name] = runs
    return found


def explain(
    results: Annotated[str, typer.Argument(metavar="RESULTS")],
    *,
    protocol: options.Text = None,
    episode: Annotated[int | None, typer.Option(min=0)] = None,
    agent: options.Text = None,
    backend: options.Text = None,
    metric: str = "last_fractional_success",
    versus: options.Text = None,
    trust: options.Words = None,
) -> None:
    """Print which variables decided the scores, or what an episode would have been without them.

    Example: scm-world explain results.json --protocol P8 --episode 3

    Args:
        results: Folder or results.json of an evaluation, or its URL.
        protocol: Name of a protocol; all that vary something by default.
        episode: Episode whose counterfactuals are run, one for each variable.
        agent: Name of a policy, if there are several.
        backend: Backend, if there are several.
        metric: Score that is explained.
        versus: Value of the variable instead: A (from the training support) or default.
    """
    from scm_world.evaluation import Evaluation, why

    if trust:
        sys.path.insert(0, str(Path.cwd()))  # for modules of the working directory
    found = Evaluation.load(results)
    for name, given, known in (
        ("--agent", agent, found.agents),
        ("--backend", backend, found.engines),
    ):
        one_of(name, given, (*known, None) if len(known) == 1 else known)
    chosen = {"agent": agent or found.agents[0], "engine": backend or found.engines[0]}
    if episode is None:
        for name in found.protocols if protocol is None else (protocol,):
            causes = found.causes(name, metric, **chosen)
            score = found.score(name, metric, **chosen)
            about = f"{chosen['agent']} on {chosen['engine']}, {metric.replace('_', ' ')} {score}"
            console.say(f"{name}: {about}", str(causes) or "nothing is varied in it", "")
        return
    if protocol is None:
        raise typer.BadParameter("an episode needs its protocol", param_hint="'--protocol'")
    with console.progress("counterfactuals") as tell:
        reasons = why(
            found.only(**chosen),
            protocol,
            episode,
            metric=metric,
            versus=versus,
            trusted=tuple(trust or ()),
            progress=tell,
        )
    title = f"{protocol}, episode {episode}: {metric.replace('_', ' ')} {reasons.score:.3g}"
    console.say(title, reasons)
