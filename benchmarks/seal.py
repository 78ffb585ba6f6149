# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What a signature costs: a sample of u as bytes and back, without a key and with one, best of many.

python -m benchmarks.seal
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
    for name, seals in (
        ("no key", (None, None)),
        ("key", tuple(MessageAuthenticator(bytes(32), "/u", None) for _ in range(2))),
    ):
        encoder, decoder = Encoder(INPUTS, "/controller#4711", seals[0]), Decoder(INPUTS, seals[1])
        message = encoder.encode(1, VALUES)
        decoder.decode(message)  # learns the layout

        def encode(encoder: Encoder = encoder) -> None:
            encoder.encode(2, VALUES)

        def decode(decoder: Decoder = decoder, message: bytes = message) -> None:
            decoder.decode(message)

        cost = [min(repeat(call, number=CALLS, repeat=TIMES)) / CALLS * 1e6 for call in (encode, decode)]
        print(f"{name:10}{len(message):8}{cost[0]:12.1f}{cost[1]:12.1f}")


if __name__ == "__main__":
    main()
