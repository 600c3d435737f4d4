"""The commands that make policies, score them and explain scores."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from scm_world._arguments import one_of
from scm_world.cli import console, options
from scm_world.cli.options import load_system, parse_assignments, parse_value, refused, split, tag
from scm_world.errors import ConflictingTargets, UnknownOption

if TYPE_CHECKING:
    from scm_world.training.loop import Trained


SHOWN = 10
"""Rows about the control steps of an episode, about."""


@dataclass
class Training:
    """Options of the making of a policy."""

    observations: Annotated[str | None, typer.Option(show_default="plain")] = None
    backend: options.Backend = None
    seed: options.NotNegative = 0
    out: options.Out = None
    changes: Annotated[list[str] | None, typer.Option("--set", metavar="NAME=VALUE")] = None
    quiet: bool = False

    def fields(self, **given: object) -> dict[str, Any]:
        """Return the fields of ``--set``, and those that have an option of their own."""
        found = parse_assignments(self.changes, "'--set'")
        for name, value in (given | {"observations": self.observations}).items():
            if value is not None and name in found:
                raise ConflictingTargets((f"--{name}", f"--set {name}"), name)
            found |= {} if value is None else {name: value}
        return found

    @contextmanager
    def job(self, task: str, *words: str, files: str, what: str) -> Iterator[dict[str, Any]]:
        """Print progress, and after Ctrl-C which files are safe; yield arguments of the work."""
        used = self.backend or load_system(task).task().backend
        folder = console.results_folder(self.out, *words, str(self.seed))
        bar = nullcontext() if self.quiet else console.progress(what)
        with console.resumable(folder, files, f"files of {what}"), bar as progress:
            yield {
                "out": folder,
                "seed": self.seed,
                "backend": used,
                "progress": progress,
                "tell": None if self.quiet else partial(console.say, stderr=True),
            }

    @staticmethod
    def tell(found: Trained, task: str) -> None:
        """Print the files of a training, and the command that evaluates its policy."""
        score = "" if found.score is None else f", {found.score:.3f} in the evaluations on the way"
        console.say(
            f"policy:   {found.policy}",
            f"best:     {found.best}{score}",
            f"evaluate: scm-world evaluate {found.best} {task}",
        )


def train(
    task: options.System,
    *,
    algo: options.Text = None,
    curriculum: options.Text = None,
    recipe: Path | None = None,
    steps: int | None = None,
    threads: int | None = None,
    start: Path | None = None,
    device: str = "auto",
    log: options.Text = None,
    sweep: options.Pairs = None,
    trials: Annotated[int | None, typer.Option(min=1)] = None,
    onnx: bool = False,
    show_recipe: bool = False,
    common: Training,
) -> None:
    """Train an agent; write its policy, its learning curve and checkpoints.

    After Ctrl-C it writes a checkpoint and ends (exit code 130); the same command resumes.
    Example: scm-world train reaching --set n_steps=128 --out my-reacher

    Args:
        algo: ppo, sac or td3 of Stable-Baselines3, recurrent_ppo of sb3-contrib, or rsl_ppo of
            rsl-rl; by default ppo, on an engine that steps thousands of worlds together rsl_ppo.
        curriculum: Variation: 0 for none, 1 for goals, 2 for everything (gravity and gains, too),
            a protocol such as P10, or the JSON file of a curriculum; by default the tuned one.
        recipe: JSON file of a recipe; by default the one tuned for the task.
        steps: Control steps, of all worlds together; those of the recipe by default.
        threads: Threads of the backend and of torch; by default as many as there are cores for the
            backend, and one for torch.
        start: Policy to start from.
        device: auto, cpu or cuda.
        log: Where the numbers of each round go besides progress.csv: tensorboard, wandb or trackio,
            several with commas; by default tensorboard, if the library has it.
        sweep: Search for a value of the recipe: NAME=LOW:HIGH, NAME=LOW:HIGH:log, or NAME=[A,B] for
            one of a list. Each trial is a training; the best recipe is in best.json.
        trials: Trainings of a search; 20 by default.
        onnx: Write the policy as ONNX, too.
        show_recipe: Print the recipe as JSON, and do nothing.
    """
    from scm_world.training.recipe import Recipe, usual_algorithm
    from scm_world.training.recipe import recipe as usual

    fields = common.fields(curriculum=curriculum, steps=steps)
    for name, where in (("task", "the task stands before the options"), ("algo", "give --algo")):
        if name in fields:
            raise UnknownOption(f"{name} after --set", fields[name], (f"none: {where}",))
    if recipe is None:
        made = usual(task, algo or usual_algorithm(common.backend), **fields)
    else:
        made = Recipe.load(recipe, trusted=(task,))
        for name, typed, its in (("task", task, made.task), ("algo", algo, made.algo)):
            if typed not in (its, None):
                raise UnknownOption(name, typed, (f"{its}, as in {recipe}",))
        made = made.but(**fields)
    if show_recipe:
        typer.echo(made.to_json())
        return
    if trials is not None and not sweep:
        raise UnknownOption("trials", trials, ("none without --sweep NAME=LOW:HIGH",))

    from scm_world.training import loop

    words = "train", tag(made.task), made.algo, made.name
    if sweep:
        from scm_world.training.sweep import sweep as search

        space = parse_assignments(sweep, "'--sweep'", _range)
        how: dict[str, Any] = {"start": start, "device": device, "threads": threads, "log": log}
        with common.job(task, "sweep", *words, files="results/*.json", what="trials") as job:
            tried = search(made, space, trials=trials or 20, **how, **job)
        console.frame(
            [{"trial": r["number"], "score": r["score"], **r["values"]} for r in tried.rows]
        )
        console.written(tried.folder / "sweep.json", tried.folder / "sweep.csv")
        if tried.best is not None:
            console.say(f"train:    scm-world train {task} --recipe {tried.folder / 'best.json'}")
        return
    with common.job(task, *words, files="checkpoints/*.zip", what="steps") as job:
        found = loop.train(made, start=start, device=device, threads=threads, log=log, **job)
    common.tell(found, made.task)
    if onnx:
        from scm_world.training.export import to_onnx

        console.say(f"ONNX:     {to_onnx(found.best, found.best.with_suffix('.onnx'))}")


def _range(text: str, hint: str) -> object:
    """Read ``LOW:HIGH`` and ``LOW:HIGH:log``; any other value as it is."""
    ends = [parse_value(one, hint) for one in text.split(":")]
    return tuple(ends) if len(ends) > 1 else ends[0]


def clone(
    task: options.System,
    *,
    from_: options.Text = None,
    episodes: int | None = None,
    protocols: options.Text = None,
    noise: float | None = None,
    rounds: int | None = None,
    workers: options.ManyWorkers = 0,
    common: Training,
) -> None:
    """Train a network by imitation of a scripted or trained policy, or of recordings.

    Episodes that end well are learned from. After an interruption the same command resumes.
    'scm-world evaluate' takes the policy. 'scm-world train --start' starts from it where the recipe
    observes and acts alike and it has no memory. Omitted options
    have values that work for the task.
    Example: scm-world clone picking --episodes 200 --out my-picker

    Args:
        from_: A policy that sees the whole world, such as feedback; a trained one, in its own
            observations: the folder of its run, its file or zoo:NAME; a recording (.parquet), or a
            folder of recordings.
        episodes: Demonstrations of the teacher.
        protocols: Protocols of these demonstrations: names with commas.
        noise: Largest noise of actions in them.
        rounds: Further rounds, in which the network acts, too.
        backend: Physics backend, or several with commas, which take turns; by default that of the
            task.
        workers: How many files of 25 demonstrations are recorded at the same time; 0 for as many
            as there are cores.
    """
    from scm_world.policies.scripted import NAMED
    from scm_world.runs.processes import cores
    from scm_world.training import imitation

    is_policy = from_ is not None and (from_ in NAMED or imitation.is_policy(from_))
    fields = common.fields(
        teacher=from_ if is_policy else None,
        episodes=episodes,
        protocols=None if protocols is None else split(protocols),
        noise=noise,
        rounds=rounds,
    )
    made = imitation.lesson(task, **fields)
    path = None if from_ is None or is_policy else Path(from_)
    if path is not None and not path.exists():
        allowed = "a trained policy or the folder of its run", "a recording or a folder of some"
        raise UnknownOption("--from", from_, (*NAMED, *allowed))
    who = made.teacher.replace(":", "-") if path is None else str(path)
    words = "clone", tag(made.task), Path(who).stem
    with common.job(task, *words, files="demonstrations/*.npz", what="episodes") as job:
        found = imitation.clone(path, made, workers=workers or cores(), **job)
    common.tell(found, task)


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
    repeats: Annotated[int | None, typer.Option(min=1)] = None,
    steps: bool = False,
    reference: options.Text = None,
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
            default the task of the policy, or pushing.
        protocols: Names with commas, such as P0,P5; all of the task by default. P2@100 intervenes
            within episodes, from control step 100 on.
        n: Episodes of each protocol, for each seed.
        seeds: Seeds of the draws and of all other noise, with commas.
        backend: Physics backend: mujoco, bullet, step, fake or trifinger_platform; or two with a
            comma, compared. That of the task by default.
        env: Option of the environment, such as frame_skip=3.
        metric: Score that is shown and drawn; all are written. By default
            last_fractional_success, or return where a task has none.
        repeats: For how many episodes in a row each draw holds, for agents that remember.
        steps: Keep the reward of each control step, and show it since an intervention within
            episodes.
        reference: Name of the policy with which the others are compared.
    """
    from scm_world import evaluation
    from scm_world.evaluation import METRICS
    from scm_world.evaluation.figures import write_figures
    from scm_world.evaluation.preparation import task_of

    sys.path.insert(0, str(Path.cwd()))  # for modules of the working directory
    one_of("metric", metric, (None, *METRICS))
    agents = policies_of(policy)
    one_of("--reference", reference, (None, *agents))
    task = task or task_of(agents)
    made = load_system(task, option).task()
    settings = parse_assignments(env, "'--env'")
    if option:
        settings["task_options"] = dict(made.given)
    words = *agents, task, *(option or ()), *(env or ())
    folder = console.results_folder(out, "evaluate", *words)
    named = (text.partition(":")[0] for runs in agents.values() for text in runs if ":" in text)
    how: dict[str, Any] = {"task": task, "n": n, "seeds": seeds, "env": settings}
    how |= {"repeats": repeats, "steps": steps}
    if trust:
        how["trusted"] = (*trust, *(name.partition(".")[0] for name in named))
    with jobs.open("episodes", folder, "parts/*.json", "files") as job:
        found = evaluation.evaluate(
            agents, protocols, backend=backend or made.backend, **how, **job
        )
    metric = found.metric(metric)
    files = *found.save(folder), *write_figures(found, folder, metric, reference=reference)
    docs = {one["name"]: one.get("doc", "") for one in found.about["protocols"]}
    engines = found.engines
    rows, gaps, regrets, learned, curves = [], [], [], [], []
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
        for engine, agent in product(engines, found.agents):
            who = {"protocol": name, "policy": agent} | (
                {"backend": engine} if len(engines) > 1 else {}
            )
            if reference not in (None, agent):
                pair = {"regret": found.regret(agent, str(reference), name, metric, engine=engine)}
                wins = found.probability_of_improvement
                pair["better"] = wins(agent, str(reference), name, metric, engine=engine)
                regrets.append({**who, **pair})
            if repeats and repeats > 1:
                *each, last = found.attempts(name, metric, agent=agent, engine=engine)
                numbered = {f"episode {k}": score for k, score in enumerate(each, 1)}
                learned.append({**who, **numbered, "last - first": last})
            if steps and "@" in name:
                size = -(-(found.rewards.shape[1]) // SHOWN)  # type: ignore[union-attr] # asked for
                shown = found.since(name, agent=agent, engine=engine, every=size)
                curves += [{**who, **row} for row in shown.to_dict("records")]
    console.frame(rows, title=f"{metric.replace('_', ' ')} in {found.task}, with 95 % intervals")
    if regrets:
        said = f"regret to {reference}, and probability to score higher than it, by draw"
        console.frame(regrets, title=said)
    if learned:
        console.frame(learned, title=f"{repeats} episodes of each draw, one after another")
    if curves:
        console.frame(curves, title="mean reward by control step since the intervention")
    if gaps:
        console.frame(gaps, title=f"{' minus '.join(engines)}, the same draws on both")
    console.written(*files)


def policies_of(text: str) -> dict[str, list[str]]:
    """Return the runs of each policy by its name: of ``NAME=A+B`` those of A and of B."""
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
    metric: options.Text = None,
    versus: options.Text = None,
    inferred: Annotated[str | None, typer.Option(metavar="PATH")] = None,
    trust: options.Words = None,
) -> None:
    """Print which variables decided the scores, or the counterfactuals of one episode.

    Example: scm-world explain results.json --protocol P8 --episode 3

    Args:
        results: Folder or results.json of an evaluation, or its URL.
        protocol: Name of a protocol; all that vary something by default.
        episode: Episode whose counterfactuals are run, one for each variable.
        agent: Name of a policy, if there are several.
        backend: Backend, if there are several.
        metric: Score that is explained. By default last_fractional_success, or success or return
            where a task has none.
        versus: Value of the variable instead: A (from the training support) or default.
        inferred: What 'scm-world infer' has written for this agent: variables that matter and
            that it does not infer are marked.
    """
    from scm_world.evaluation import Evaluation, Inferred, why
    from scm_world.evaluation.statistics.causes import missing
    from scm_world.evaluation.verdicts import verdicts_of

    if trust:
        sys.path.insert(0, str(Path.cwd()))  # for modules of the working directory
    found = Evaluation.load(results)
    for name, given, known in (
        ("--agent", agent, found.agents),
        ("--backend", backend, found.engines),
    ):
        one_of(name, given, (*known, None) if len(known) == 1 else known)
    metric = found.metric(metric)
    chosen = {"agent": agent or found.agents[0], "engine": backend or found.engines[0]}
    judged = None if inferred is None else Inferred.load(inferred)
    if episode is None:
        for name in found.protocols if protocol is None else (protocol,):
            causes = found.causes(name, metric, **chosen, inferred=judged)
            score = found.score(name, metric, **chosen)
            about = f"{chosen['agent']} on {chosen['engine']}, {metric.replace('_', ' ')} {score}"
            console.say(f"{name}: {about}", str(causes) or "nothing is varied in it", "")
        return
    if protocol is None:
        raise typer.BadParameter("an episode needs its protocol", param_hint="'--protocol'")
    how: dict[str, Any] = {"metric": metric, "versus": versus, "trusted": tuple(trust or ())}
    with console.progress("counterfactuals") as tell:
        reasons = why(found.only(**chosen), protocol, episode, **how, progress=tell)
    title = f"{protocol}, episode {episode}: {metric.replace('_', ' ')} {reasons.score:.3g}"
    matter = [one.variable for one in reasons.others if one.gain]
    verdicts = verdicts_of(judged, found.about, chosen["agent"])
    console.say(title, reasons, *missing(verdicts, matter))


def infer(
    policy: Annotated[str, typer.Argument(metavar="POLICY")],
    task: Annotated[str | None, typer.Argument(metavar="SYSTEM")] = None,
    *,
    variables: Annotated[str, typer.Option()],
    space: str = "A",
    steps: options.Text = None,
    at: Annotated[int | None, typer.Option(min=0)] = None,
    after: Annotated[int | None, typer.Option(min=0)] = None,
    privileged: options.Text = None,
    n: options.N = 200,
    seed: options.NotNegative = 0,
    backend: options.Text = None,
    env: options.Pairs = None,
    option: options.Pairs = None,
    trust: options.Words = None,
    out: options.Out = None,
    jobs: options.ManyJobs,
) -> None:
    """Find out which hidden causes a policy infers, and how its actions follow them.

    Probes of its hidden state, with controls, and twin episodes in which a cause is set. Writes
    inferred.json. After Ctrl-C (exit code 130) the same command resumes.
    Example: scm-world infer zoo:pushing --variables tool_block.mass -n 100

    Args:
        policy: As for 'scm-world evaluate', one.
        task: As for 'scm-world evaluate'.
        variables: Names or patterns of the causes, with commas.
        space: Where they are drawn from: A, B or A|B.
        steps: Control steps that are probed, with commas, in addition to the last one; by default
            5,25,100.
        at: Control step at which twin episodes set a cause, 0 for none; by default 25, or a quarter
            of a shorter episode.
        after: Control steps until actions are compared; likewise.
        privileged: A policy that sees the causes, to compare the direction of changes.
        n: Episodes.
        seed: Seed of the noise.
        backend: Physics backend; that of the task by default.
        env: Option of the environment, such as history=8.
    """
    from scm_world import evaluation
    from scm_world.evaluation.preparation import task_of

    sys.path.insert(0, str(Path.cwd()))  # for modules of the working directory
    task = task or task_of(policy)
    made = load_system(task, option).task()
    settings = parse_assignments(env, "'--env'")
    if option:
        settings["task_options"] = dict(made.given)
    folder = console.results_folder(out, "infer", tag(policy), tag(task), variables, str(seed))
    how: dict[str, Any] = {"task": task, "n": n, "seed": seed, "env": settings}
    how |= {"at": at, "after": after, "privileged": privileged}
    named = (text.partition(":")[0] for text in (policy, privileged or "") if ":" in text)
    if trust:
        how["trusted"] = (*trust, *(name.partition(".")[0] for name in named))
    if steps is not None:
        if not all(map(str.isdecimal, split(steps))):
            raise refused(steps, "expected control steps with commas, such as 5,25", "'--steps'")
        how["steps"] = [int(word) for word in split(steps)]
    drawn = evaluation.Protocol("drawn", split(variables), space)
    with jobs.open("episodes", folder, "parts/*.npz", "files") as job:
        found = evaluation.inferred(policy, drawn, backend=backend or made.backend, **how, **job)
    console.say(found)
    console.written(found.save(folder / "inferred.json"))
