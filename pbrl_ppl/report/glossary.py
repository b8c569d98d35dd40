"""What the names in a report mean, for a reader who has not read the paper."""

from __future__ import annotations

from collections.abc import Iterable

from pbrl_ppl.effects import Effect

#: Of parameters, by the variable's name.
PARAMETERS = {
    "mass": "mass",
    "r": "elasticity in contacts: 0 keeps no speed, 1 all of it",
    "mu_c": "friction where it touches others",
    "w_x": "place of the wheel along the body",
    "w_y": "place of the wheel across the body",
    "w_theta": "direction in which the wheel rolls",
    "mu_x": "friction of the wheel along that direction",
    "mu_y": "friction of the wheel across it",
    "i_a": "number of the first body that a joint joins",
    "i_b": "number of the second; the same one means no joint",
    "a_x": "anchor of a joint on its first body, along it",
    "a_y": "anchor of a joint on its first body, across it",
    "b_x": "anchor of a joint on its second body, along it",
    "b_y": "anchor of a joint on its second body, across it",
    "sigma": "typical error of measuring it (standard deviation)",
    "unexplained_acceleration": "typical acceleration that nothing in the model explains",
    "contact_acceleration": "the same, on top, where bodies touch",
}

#: Of statistics, in the order in which a reader meets them.
STATISTICS = {
    "posterior": "What is believed of a parameter after the data; the prior is what was before.",
    "94 % interval": "The narrowest interval that holds 94 % of the posterior's probability.",
    "sd": "Standard deviation: the typical distance from the mean.",
    "score": "How strongly the model's errors look as a missing effect would make them look; a"
    " statistic that chance alone keeps about as small as its degrees of freedom.",
    "p": "How often chance alone would bring a result as strong.",
    "nat": "Unit of evidence: one nat makes the data e = 2.7 times as likely.",
    "elpd": "Expected log predictive density: how likely data are under a model that has not seen"
    " them, in nats; more is better.",
    "LOO": "Leave-one-out cross-validation: elpd of each transition given all others; of whole"
    " trajectories leave-one-trajectory-out, elpd of each trajectory given all others.",
    "Pareto k": "How far leaving one of them out changes the posterior; above the threshold, LOO"
    " is not to be relied on.",
    "R-hat": "Spread of all chains over that within one; 1 if they agree, at most 1.01 is wanted.",
    "ESS": "Effective sample size: how many independent draws the chains are worth; at least 400"
    " are wanted.",
    "noise floor": "Error that a perfect model would have, from the noise of the measurements.",
    "transition": "One interval of the recording: a state, a command, the next state.",
}


def meaning(label: str, effects: Iterable[Effect]) -> str:
    """What a parameter such as ``mass[cart]`` is, in a few words; empty if that is not known."""
    name = label.partition("[")[0]
    if name in PARAMETERS:
        return PARAMETERS[name]
    for effect in effects:
        for parameter in effect.parameters:
            if effect.variable(parameter) == name:
                return (
                    f"{parameter.name.replace('_', ' ')} of the effect"
                    f" {effect.name.replace('_', ' ')}"
                )
    return ""
