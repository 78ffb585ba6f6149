# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Sign check of a channel map: signs from its rows and the airframe."""

import numpy as np

from autopilot_bridge.params import MOTIONS, ChannelMap
from flight_core.parameters import require
from flight_core.vectors import FloatArray


def output_signs(channel_map: ChannelMap) -> FloatArray:
    """+1 for each output with the sign convention of the stack (q nose up, p roll right, r nose right, V faster), otherwise -1.

    Shape (m,) in the map's order. Raises ParameterError where the motion of a row does not belong to its channel.
    """
    signs = []
    for name, row in channel_map.outputs.items():
        output, sign = row.motion
        channels = sorted({channel for channel, _ in MOTIONS.values()})
        key = f"map {channel_map.name}: outputs.{name}"
        require(name in channels, key, "a channel", f"one of {', '.join(channels)}")
        require(output == name, f"{key}.positive", f"{row.positive!r}", f"a motion to which {name} responds")
        signs.append(sign)
    return np.array(signs, dtype=np.float64)


def input_signs(channel_map: ChannelMap, Omega: FloatArray) -> FloatArray:
    """+1 for each input whose effect has the sign of Omega = C B, otherwise -1; shape (m,).

    Arguments: Omega (m, m), rows and columns in the map's order. Raises ParameterError for an input without effect on its
    output.
    """
    signs = []
    for j, (name, row) in enumerate(channel_map.inputs.items()):
        output, sign = row.motion
        key = f"map {channel_map.name}: inputs.{name}.positive"
        outputs = list(channel_map.outputs)
        require(output in outputs, key, f"{row.positive!r}", f"a motion to which one of {', '.join(outputs)} responds")
        effect = Omega[outputs.index(output), j]
        require(effect != 0.0, key, f"{row.positive!r}", f"a motion by {name}: in the airframe {output} does not respond")
        signs.append(sign * np.sign(effect))
    return np.array(signs)


def through(channel_map: ChannelMap, Omega: FloatArray) -> FloatArray:
    """Omega between the channels of the map: diag(output signs) Omega diag(input signs), shape (m, m)."""
    return output_signs(channel_map)[:, None] * Omega * input_signs(channel_map, Omega)
