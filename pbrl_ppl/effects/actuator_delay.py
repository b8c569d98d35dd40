"""Pure time delay of the command."""

from typing import Any

from pbrl_ppl.effects.effect import Effect, EffectParameter
from pbrl_ppl.effects.stages import Command
from pbrl_ppl.parameters import Prior


def _law(state: Any, command: Any, parameters: Any, wrench: Any) -> None:
    # a delay that ends inside a substep is blended: the likelihood stays smooth in it
    begin, end = command[6], command[7]
    late = min(1.0, max(0.0, (parameters[0] - begin) / (end - begin)))
    for i in range(3):
        wrench[i] = late * command[3 + i] + (1.0 - late) * wrench[i]


actuator_delay = Effect(
    "actuator_delay",
    (
        EffectParameter(
            "share", "1", Prior("truncated_normal", mu=0.0, sigma=0.5, lower=0.0, upper=1.0)
        ),
    ),
    "the push arrives late, by this share of the sampling interval (actuator_delay), or what is"
    " measured does (sensor_delay); with one clock in the log the two are the same data",
    "pure time delay of a held input, u(t - share dt)",
    Command(_law, memory=True),
)
