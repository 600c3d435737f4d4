"""Many environments in processes: Gymnasium's ``AsyncVectorEnv``, with interventions."""

from __future__ import annotations

import multiprocessing
import pickle
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from gymnasium.vector.utils import create_empty_array

from scm_world._arguments import whole_number
from scm_world._types import Floats, Integers
from scm_world.env.environment import ScmWorldEnv
from scm_world.env.many import ScmWorldVectorEnv, act, member_shapes, read_mode, row_of
from scm_world.errors import EngineFailure, ScmWorldError
from scm_world.runs.processes import PROCESS, children_single_threaded, pickled
from scm_world.world.batch import Mask, located

ANEW = "make the environments again"


@final
class ProcessVectorEnv(ScmWorldVectorEnv):
    """Environments each in a process of its own: how backends without threads use all cores.

    Gymnasium's ``AsyncVectorEnv`` runs the processes and keeps the observations in shared memory.

    Args:
        num_envs: How many.
        autoreset_mode: As in ``ScmWorldVectorEnv``.
        copy: Likewise.
        workers: How many of them are simulated at the same time; all if None. Results do not
            depend on it.
        member: Makes one of them from the options.
        options: Of ``ScmWorldEnv``.

    Raises:
        UnknownOption: Something that processes need cannot be pickled.
        EngineFailure: A process ended. All of them are lost then.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        copy: bool = True,
        workers: int | None = None,
        member: Callable[..., gymnasium.Env[Any, Any]] = ScmWorldEnv,
        **options: Any,
    ) -> None:
        count = whole_number("num_envs", num_envs, least=1)
        mode = read_mode(autoreset_mode)
        # A server that has imported this package starts processes quickest.
        kinds = multiprocessing.get_all_start_methods()
        context = "forkserver" if "forkserver" in kinds else "spawn"
        multiprocessing.get_context(context).set_forkserver_preload([__name__])
        make = partial(member, **options)
        with children_single_threaded():
            self._envs: Any = AsyncVectorEnv(
                [partial(Member, make, index) for index in range(count)],
                copy=False,
                context=context,
                autoreset_mode=AutoresetMode.DISABLED,  # the next episodes begin from here
                max_concurrency=workers,
            )
        super().__init__(
            count,
            self._envs.single_observation_space,
            self._envs.single_action_space,
            metadata=self._envs.metadata,
            render_mode=self._envs.render_mode,
            autoreset_mode=mode,
            copy=copy,
        )
        self._seen = self._envs.observations  # shared memory
        self._lost = ""

    def _advance(self, which: Mask, actions: Floats) -> None:
        if not which.any():
            return
        given = np.where(which[:, None], actions, np.nan)
        with self._in_step():
            _, rewards, terminations, truncations, infos = self._envs.step(given)
        stepped = self._without_error(infos, which)
        self._rewards[stepped] = rewards[stepped]
        self._terminations[stepped] = terminations[stepped]
        self._truncations[stepped] = truncations[stepped]
        self._copy(infos, stepped)
        if "error" in infos:
            raise _first(infos)

    def _act(self, method: str, given: Mapping[int, Mapping[str, Any]]) -> dict[int, Any]:
        what = f"argument of {method}"
        asked = {index: pickled(what, (method, one)) for index, one in given.items()}
        infos = self._ask(asked)
        if "error" in infos:
            undo = pickled(UNDO, (UNDO, {}))
            self._ask({index: undo for index in given if not infos["_error"][index]})
            raise _first(infos)
        self._copy(infos, np.array([*given], dtype=int))
        return {index: infos["answer"][index][0] for index in given}

    def _ask(self, asked: Mapping[int, bytes]) -> dict[str, Any]:
        with self._in_step():
            _, infos = self._envs.reset(options={"asked": asked})
        found: dict[str, Any] = infos
        return found

    def _copy(self, infos: Mapping[str, Any], rows: Integers) -> None:
        """Keep the infos of some environments; the observations are in shared memory already."""
        if len(rows):
            self._write(rows, None, _rows(infos, rows))

    def present(self) -> tuple[Any, dict[str, Any]]:
        """Return observations and infos of the present, as after an intervention."""
        asked = pickled(PRESENT, (PRESENT, {}))
        infos = self._ask(dict.fromkeys(np.flatnonzero(self._begun).tolist(), asked))
        self._copy(infos, self._without_error(infos, self._begun))
        return super().present()

    def _without_error(self, infos: Mapping[str, Any], which: Mask) -> Integers:
        """Return those of some environments that told no error."""
        return np.flatnonzero(which & ~infos.get("_error", np.zeros(self.num_envs, bool)))

    def call_in(self, indices: Iterable[int], name: str, *args: Any, **kwargs: Any) -> list[Any]:
        """Call a method of some environments; return what cannot be called as it is."""
        chosen = [*indices]
        asked = pickled(f"argument of {name}", (chosen, name, args, kwargs))
        with self._in_step():
            answers = self._envs.call("answer", asked)
        for index in chosen:
            if answers[index][1] is not None:
                raise answers[index][1]
        return [answers[index][0] for index in chosen]

    def _assign(self, name: str, values: Sequence[Any]) -> None:
        pickled(f"value of {name}", values)
        with self._in_step():
            self._envs.set_attr(name, values)

    def close_extras(self, **kwargs: Any) -> None:
        """End the processes."""
        if not self._lost:
            self._envs.close(**kwargs)
            self._lost = f"the environments are closed; {ANEW}"

    @contextmanager
    def _in_step(self) -> Iterator[None]:
        """Ask all processes; one that is not like the others any more ends all of them."""
        if self._lost:
            raise EngineFailure(self._lost, PROCESS)
        try:
            yield
        except BaseException as error:
            self._lost = f"they were interrupted by {type(error).__name__}; {ANEW}"
            for process in self._envs.processes:
                process.join(0.1)
            ended = [p.exitcode for p in self._envs.processes]
            for process in self._envs.processes:
                process.kill()
                process.join()
            self._envs.closed = True
            if not isinstance(error, EOFError | OSError):
                raise
            gone = {i: code for i, code in enumerate(ended) if code is not None}
            text = ", ".join(f"environment {i} with exit code {c}" for i, c in gone.items())
            self._lost = f"a process ended: {text or repr(error)}; {ANEW}"
            raise EngineFailure(self._lost, PROCESS) from None


PRESENT, UNDO = "present", "undo"


@final
class Member(gymnasium.Wrapper[Any, Any, Any, Any]):
    """One of many environments, in a process of its own: it answers by its number.

    Gymnasium ends a process that raises an error, so errors are answers, too.

    Args:
        make: Makes the environment.
        index: Its number.
    """

    def __init__(self, make: Callable[[], gymnasium.Env[Any, Any]], index: int) -> None:
        super().__init__(make())
        self._index, self._shapes = index, member_shapes(self.env)
        self._seen = row_of(create_empty_array(self.env.observation_space, 1, np.zeros), 0)
        self._before: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Call the method that is asked of this environment, such as ``reset``, if any is.

        Returns:
            The present observation and info, with ``"answer"`` or ``"error"``.
        """
        asked = (options or {})["asked"].get(self._index)
        if asked is None:
            return self._seen, {}
        method, given = pickle.loads(asked)  # noqa: S301 # written by our own process
        inner: Any = self.env.unwrapped
        if method == UNDO:
            self._undo()
            return self._seen, {}
        snapshot = self.env.get_wrapper_attr("snapshot")
        self._before = snapshot() if inner.world.has_begun else None
        try:
            answer, (self._seen, info) = act(self.env, self._shapes, method, given)
        except Exception as error:
            self._undo()
            return self._seen, {"error": portable(error)}
        return self._seen, {**info, "answer": (answer,)}

    def _undo(self) -> None:
        inner: Any = self.env.unwrapped
        if self._before is not None:
            self.env.get_wrapper_attr("restore")(self._before)
            with suppress(ScmWorldError):  # what cannot be read stays as it was seen
                self._seen, _ = inner.present()

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Advance one control step; not a number stands for none."""
        if np.isnan(action).any():
            return self._seen, 0.0, False, False, {}
        try:
            self._seen, *rest, info = self.env.step(action)
        except ScmWorldError as error:
            return self._seen, 0.0, False, False, {"error": portable(error)}
        return self._seen, *rest, info

    def set_wrapper_attr(self, name: str, value: Any, *, force: bool = True) -> bool:
        """Set an attribute of the environment, not of this wrapper."""
        return bool(self.env.set_wrapper_attr(name, value, force=force))

    def answer(self, asked: bytes) -> tuple[Any, Exception | None]:
        """Call a method, or read an attribute, if this environment is among those asked.

        Returns:
            The answer and an error: one of them is None.
        """
        indices, name, args, kwargs = pickle.loads(asked)  # noqa: S301 # as above
        if self._index not in indices:
            return None, None
        try:
            found = self.env.get_wrapper_attr(name)
            return found(*args, **kwargs) if callable(found) else found, None
        except Exception as error:
            return None, portable(error)


def portable(error: Exception) -> Exception:
    """Return an error that can be pickled: the same one, or what it says."""
    same = False
    with suppress(Exception):
        same = type(pickle.loads(pickle.dumps(error))) is type(error)  # noqa: S301 # of this line
    return error if same else EngineFailure(f"{type(error).__name__}: {error}", PROCESS)


def _first(infos: Mapping[str, Any]) -> Exception:
    """Return the first error of some environments, with its place."""
    index = int(np.argmax(infos["_error"]))
    error: Exception = infos["error"][index]
    return located(error, index, "environment") if isinstance(error, ScmWorldError) else error


def _rows(infos: Mapping[str, Any], rows: Integers) -> dict[str, Any]:
    """Return the rows of some environments of infos in Gymnasium's form, without the masks."""
    return {
        name: _rows(value, rows) if isinstance(value, dict) else value[rows]
        for name, value in infos.items()
        if f"_{name}" in infos and name not in ("answer", "error")
    }
