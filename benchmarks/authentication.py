# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Time of message authentication: encoding and decoding a sample of u without and with a key, the least of many runs.

python -m benchmarks.authentication
"""

from timeit import repeat

import numpy as np

from flight_core.authentication import MessageAuthenticator
from flight_ros.messages import Decoder, Encoder

INPUTS = ("elevator", "aileron", "rudder", "thrust")
VALUES = np.array([0.1, 0.2, 0.3, 0.4])
CALLS, TIMES = 5000, 15


def main() -> None:
    """Print us a message."""
    print(f"{'':10}{'bytes':>8}{'encode us':>12}{'decode us':>12}")
    for name, authenticators in (
        ("no key", (None, None)),
        ("key", tuple(MessageAuthenticator(bytes(32), "/u", None) for _ in range(2))),
    ):
        encoder, decoder = Encoder(INPUTS, "/controller#4711", authenticators[0]), Decoder(INPUTS, authenticators[1])
        message = encoder.encode(1, VALUES)
        decoder.decode(message)  # the first message fixes the layout

        def encode(encoder: Encoder = encoder) -> None:
            encoder.encode(2, VALUES)

        def decode(decoder: Decoder = decoder, message: bytes = message) -> None:
            decoder.decode(message)

        cost = [min(repeat(call, number=CALLS, repeat=TIMES)) / CALLS * 1e6 for call in (encode, decode)]
        print(f"{name:10}{len(message):8}{cost[0]:12.1f}{cost[1]:12.1f}")


if __name__ == "__main__":
    main()
