"""FLOP and bytes of functions, as XLA counts them (`cost_analysis`), but loops as often as they are run.

XLA counts the body of a loop once, and of several branches the dearest. Here the body of a loop whose length is known
when it is compiled counts that often; one that ends when it is done counts once. Of branches the one that is taken
counts, where the arguments alone decide it; within loops it is the dearest, too.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.extend import core


@dataclasses.dataclass(frozen=True)
class Cost:
    """Of one call: floating-point operations, and bytes read and written."""

    flop: float
    bytes: float

    def __add__(self, other: "Cost") -> "Cost":
        return Cost(self.flop + other.flop, self.bytes + other.bytes)

    def __sub__(self, other: "Cost") -> "Cost":
        return self + other.times(-1)

    def times(self, count: float) -> "Cost":
        return Cost(count * self.flop, count * self.bytes)


NOTHING = Cost(0.0, 0.0)


def counted(function: Callable, *arguments: Any, programs: tuple[Any, Any] | None = None) -> Cost:
    """What a call of a function with these arguments costs.

    FLOP are those of the program as it was traced, bytes those of the compiled one, whose fused steps write nothing.

    Args:
        programs: the function lowered and compiled for these arguments, if it has been.
    """
    traced = jax.make_jaxpr(function)(*arguments)
    return _Counter().count(traced, programs, jax.tree.leaves(arguments)).whole


@dataclasses.dataclass(frozen=True)
class _Count:
    """With every loop and the dearest branch once, as XLA counts; and as it is run."""

    once: Cost
    whole: Cost


class _Counter:
    """Counts; what is the same is counted once."""

    def __init__(self):
        self.known: dict[str, _Count] = {}

    def count(
        self, traced: core.ClosedJaxpr, programs: tuple[Any, Any] | None = None, given: Sequence[Any] | None = None
    ) -> _Count:
        name = str(traced.jaxpr)
        if given is not None or name not in self.known:
            if programs is None:
                shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype, weak_type=x.weak_type) for x in traced.in_avals]
                lowered = jax.jit(core.jaxpr_as_fun(traced)).lower(*shapes)
                programs = lowered, lowered.compile()
            once = Cost(_figure(programs[0], "flops"), _figure(programs[1], "bytes accessed"))
            lookups = None if given is None else [lambda value=value: value for value in given]
            self.known[name] = _Count(once, once + self._more(traced, lookups))
        return self.known[name]

    def _more(self, traced: core.ClosedJaxpr, arguments: Sequence[Callable[[], Any]] | None) -> Cost:
        """What a program costs beyond what XLA counts; values of the arguments are looked up where one is needed."""
        jaxpr, more = traced.jaxpr, NOTHING
        for equation in jaxpr.eqns:
            name, parameters = equation.primitive.name, equation.params
            inputs = None if arguments is None else [_lookup(traced, arguments, x) for x in equation.invars]
            if name == "scan":
                body = self.count(parameters["jaxpr"])
                more += body.whole.times(parameters["length"]) - body.once
            elif name == "cond" and parameters.get("branches_platforms"):
                platforms = [names or () for names in parameters["branches_platforms"]]
                here = [n for n, names in enumerate(platforms) if jax.default_backend() in names]
                more += self._more(parameters["branches"][here[0] if here else -1], inputs and inputs[1:])
            elif name == "cond":
                branches = [self.count(one) for one in parameters["branches"]]
                dearest = max(branches, key=lambda one: one.whole.flop)
                taken = dearest if inputs is None else branches[int(inputs[0]())]
                more += taken.whole - Cost(
                    max(one.once.flop for one in branches), max(one.once.bytes for one in branches)
                )
            else:
                inner = [x for x in parameters.values() if isinstance(x, core.ClosedJaxpr)]
                for one in inner:  # loops without a known length have two, whose arguments change
                    more += self._more(one, inputs if len(inner) == 1 else None)
        return more


def _lookup(traced: core.ClosedJaxpr, arguments: Sequence[Callable[[], Any]], x: Any) -> Callable[[], Any]:
    """How to come by a value within a program: by running what leads to it, for the compiler drops all else."""
    if isinstance(x, core.Literal):
        return lambda: x.val

    @functools.cache
    def run() -> Any:
        part = core.ClosedJaxpr(traced.jaxpr.replace(outvars=[x]), traced.consts)
        return jax.jit(core.jaxpr_as_fun(part))(*[one() for one in arguments])[0]

    return run


def _figure(program: Any, name: str) -> float:
    found = program.cost_analysis()
    return max(float((found or {}).get(name, 0.0)), 0.0)
