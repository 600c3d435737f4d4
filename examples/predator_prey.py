"""Predator and prey as a causal model: intervene, ask what if, and discover who acts on whom.

Run it with ``python examples/predator_prey.py``. Source: Rosenzweig and MacArthur, *Graphical
representation and stability conditions of predator-prey interactions*, 1963.
"""

from typing import Any

from scm_world import Action, Box, Exogenous, Measured, World, discover
from scm_world.variables import Normal

DT, FEW = 0.1, Box(0.0, 20.0)  # [years], [thousands]


def predator_prey(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """Let hares grow and be eaten, and lynxes starve unless they eat."""
    hares, lynxes = state["hares"], state["lynxes"]
    eaten = hares * lynxes / (1.0 + parameters["handling"] * hares)
    growth = hares * (1.0 - hares / parameters["capacity"] + noise["weather"])
    births = parameters["efficiency"] * eaten - (0.3 + action["hunting"]) * lynxes
    return {"hares": hares + DT * (growth - eaten), "lynxes": lynxes + DT * births}


def make() -> World:
    """Declare the causes of each population: both populations one step before."""
    both = ("hares", "lynxes", "handling")
    return World(
        predator_prey,
        parameters=[
            Exogenous(name=name, default=value, bounds=Box(0.1, 9.0))
            for name, value in (("capacity", 4.0), ("handling", 0.5), ("efficiency", 0.6))
        ],
        states=[
            Measured(name="hares", bounds=FEW, parents=(*both, "capacity")),
            Measured(name="lynxes", bounds=FEW, parents=(*both, "efficiency", "hunting")),
        ],
        actions=[Action(name="hunting", bounds=Box(0.0, 0.5))],
        control_dt=DT,
        noise={"weather": Normal(0.0, 0.3)},
        start={"hares": 2.0, "lynxes": 1.0},
        seconds=40.0,
    )


def main(n: str = "50") -> None:
    """Do, estimate, imagine, and discover."""
    world = make()
    world.reset(seed=0)
    print(world.do({"hares": 5.0, "efficiency": 0.5}), world.graph.parents("lynxes"))
    print(world.effect("lynxes", do={"capacity": 8.0}, n=int(n)))
    lived = world.rollout("random", seed=1)
    rich = lived.counterfactual({"capacity": 8.0}, at=200)
    print("hares:", lived.final("hares"), "with more grass from year 20 on:", rich.final("hares"))
    print("nothing else, nothing different:", lived.counterfactual({}) == lived)
    print(discover(world, probes=8))


if __name__ == "__main__":
    main()
