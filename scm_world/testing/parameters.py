"""What a change of parameters does, and what it must not do."""

from __future__ import annotations

import numpy as np

from scm_world.backends.base import Backend
from scm_world.models.scene import Difference, Scene
from scm_world.tasks.trifinger import hardware
from scm_world.tasks.trifinger.state import PhysicalState
from scm_world.tasks.trifinger.system import trifinger
from scm_world.testing.scenes import (
    STONE,
    Suite,
    apart_scene,
    changed_states,
    check_parameters,
    other_value,
    play,
    same,
)


class ParameterConformance(Suite):
    """Sentences about parameters."""

    def test_every_parameter_is_read_back(self, backend: Backend, scene: Scene) -> None:
        """The engine reports each parameter as it was set."""
        keys = tuple(scene.parameters)
        check_parameters(backend.parameters(keys), scene.parameters)
        other = {key: other_value(key, scene.parameters[key]) for key in keys}
        backend.apply(Difference(parameters=other))
        check_parameters(backend.parameters(keys), other)

    def test_a_parameter_changes_nothing_else(self, backend: Backend, scene: Scene) -> None:
        """Setting one parameter leaves the state and every other parameter as they were."""
        keys = tuple(scene.parameters)
        state, before = backend.state(), backend.parameters(keys)
        for key in keys:
            backend.apply(Difference(parameters={key: other_value(key, before[key])}))
            now = backend.parameters(keys)
            assert [k for k in keys if k != key and not same(now[k], before[k])] == []
            assert backend.state() == state
            backend.apply(Difference(parameters={key: scene.parameters[key]}))

    def test_a_parameter_taken_back_leaves_no_trace(self, backend: Backend, scene: Scene) -> None:
        """Each parameter that is changed and restored has exactly no effect on the next step."""
        start = backend.snapshot()
        expected = self.continued(backend, start, 1)
        traces = []
        for key, value in scene.parameters.items():
            backend.restore(start)
            self.change_and_undo(backend, [key], scene.parameters)
            if not same(play(backend, 1), expected):
                traces.append(key)
            assert same(value, scene.parameters[key])
        assert traces == []

    def test_a_state_taken_back_leaves_no_trace(self, backend: Backend) -> None:
        """Each field of the state that is changed and restored has exactly no effect."""
        start, state = backend.snapshot(), backend.state()
        expected = self.continued(backend, start, 1)
        traces = []
        for field, changed in changed_states(state):
            backend.restore(start)
            backend.apply(Difference(state=changed))
            backend.apply(Difference(state=state))
            if backend.state() != state or not same(play(backend, 1), expected):
                traces.append(field)
        assert traces == []

    def test_changes_taken_back_leave_no_trace_for_long(
        self, backend: Backend, scene: Scene
    ) -> None:
        """All of these changes together have exactly no effect on a whole episode."""
        start, state = backend.snapshot(), backend.state()
        expected = self.continued(backend, start, self.long)
        backend.restore(start)
        self.change_and_undo(backend, scene.parameters, scene.parameters)
        for _, changed in changed_states(state):
            backend.apply(Difference(state=changed))
        backend.apply(Difference(state=state))
        assert same(play(backend, self.long), expected)

    def test_the_order_of_changes_is_irrelevant(self, backend: Backend, scene: Scene) -> None:
        """All together, one by one, in any order and with detours: the result is the same."""
        start = backend.snapshot()
        *_, (_, state) = changed_states(backend.state())
        state.positions[:, 2] += 0.1
        other = {key: other_value(key, value) for key, value in scene.parameters.items()}

        def at_once() -> None:
            backend.apply(Difference(parameters=other, state=state))

        def state_first() -> None:
            backend.apply(Difference(state=state))
            for key in sorted(other):
                backend.apply(Difference(parameters={key: other[key]}))

        def with_detours() -> None:
            for key in sorted(other, reverse=True):
                backend.apply(Difference(parameters={key: other_value(key, other[key])}))
                backend.apply(Difference(parameters={key: other[key]}))
            for _, detour in changed_states(state):
                backend.apply(Difference(state=detour))
            backend.apply(Difference(state=state))

        results = []
        for path in (at_once, state_first, with_detours):
            backend.restore(start)
            path()
            results.append(play(backend, 20))
        assert same(results[0], results[1])
        assert same(results[0], results[2])

    def test_changes_equal_a_scene_built_so(self, scene: Scene) -> None:
        """Before the first step, changing a scene and building the changed one are the same."""
        other = {key: other_value(key, value) for key, value in scene.parameters.items()}
        *_, (_, state) = changed_states(scene.state)
        with (
            self.built(scene) as edited,
            self.built(scene.with_(parameters=other, state=state)) as new,
        ):
            edited.apply(Difference(parameters=other, state=state))
            assert edited.state() == new.state()
            assert same(play(edited, 20), play(new, 20))

    def test_colors_and_fixed_masses_do_nothing(self, backend: Backend, scene: Scene) -> None:
        """Colors and the masses of what cannot move have exactly no effect."""
        start = backend.snapshot()
        expected = self.continued(backend, start, 40)
        backend.restore(start)
        idle = {
            key: other_value(key, value)
            for key, value in scene.parameters.items()
            if key[1] == "color" or (key[1] == "mass" and key[0].endswith("link_0"))
        }
        backend.apply(Difference(parameters=idle))
        assert same(play(backend, 40), expected)

    def test_every_other_parameter_acts(self, backend: Backend, scene: Scene) -> None:
        """Each remaining parameter moves something."""
        if not backend.capabilities.physics:
            return
        start = backend.snapshot()
        expected = self.continued(backend, start, 40)
        silent = []
        for key, value in scene.parameters.items():
            if key[1] == "color" or key[0].endswith("link_0"):
                continue
            backend.restore(start)
            backend.apply(Difference(parameters={key: other_value(key, value)}))
            if same(play(backend, 40), expected):
                silent.append(key)
        assert silent == []

    def test_what_touches_nothing_does_nothing(self) -> None:
        """A block that nothing touches has exactly no effect on the others, nor they on it."""
        scene = apart_scene(self.preset)
        alone, others = np.r_[27:40], np.r_[0:27, 40:53]
        with self.built(scene) as backend:
            start = backend.snapshot()
            expected = play(backend, 40)
            leaks = []
            for key, value in scene.parameters.items():
                if key[0] in ("world", "floor", "stage"):
                    continue
                untouched = others if key[0] in ("apart", "ledge") else alone
                backend.restore(start)
                backend.apply(Difference(parameters={key: other_value(key, value)}))
                if not same(play(backend, 40)[:, untouched], expected[:, untouched]):
                    leaks.append(key)
        assert leaks == []

    def test_what_touches_nothing_can_be_missing(self) -> None:
        """Without a block that nothing touches, the others move as before, but for rounding.

        An engine may sum in another order where there are fewer bodies.
        """
        scene = apart_scene(self.preset)
        with self.built(scene) as backend:
            expected = play(backend, 40)
            backend.build(scene)
            state = backend.state()
            without = PhysicalState(1, np.delete(state.vector, np.s_[27:40]))
            fewer = trifinger(("near",), preset=self.preset)
            backend.apply(Difference(structure=fewer, state=without))
            others = np.delete(expected, np.s_[27:40], axis=1)
            np.testing.assert_allclose(play(backend, 40), others, rtol=0, atol=1e-7)

    def test_inertia_follows_mass_and_size(self, backend: Backend) -> None:
        """A block is a solid body, and the inertia of a link scales with its mass."""
        mass, size = np.array(0.04), np.array([0.03, 0.05, 0.08])
        link = hardware.link_name("120", 2)
        changes = {("near", "mass"): mass, ("near", "size"): size, (link, "mass"): np.array(0.3)}
        backend.apply(Difference(parameters={**changes, ("stone", "mass"): mass}))
        squares = size**2
        expected = mass / 12.0 * (squares.sum() - squares)
        np.testing.assert_allclose(backend.inertia("near"), expected, rtol=1e-9)
        per_mass = np.array(hardware.INERTIAL[2].per_mass)
        np.testing.assert_allclose(backend.inertia(link), 0.3 * per_mass, rtol=1e-6)
        moments = mass * np.array(STONE.moments)
        np.testing.assert_allclose(backend.inertia("stone"), moments, rtol=1e-9)
