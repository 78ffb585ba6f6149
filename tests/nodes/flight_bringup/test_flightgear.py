# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The pose in FlightGear: its packet by the places of net_fdm.hxx, version 24."""

import math
import struct

import pytest
from pytest import approx

from flight_bringup.flightgear import packet
from flight_guidance.route_file import Origin, geographic, local

ORIGIN = Origin(47.38, 8.54)
FLOWN = {
    "phi": 0.1,
    "theta": 0.2,
    "psi": -1.0,
    "north": 300.0,
    "east": -40.0,
    "altitude": 50.0,
    "climb": 3.048,
    "v_north": 18.52,
}


def fields(raw: bytes) -> dict[str, float]:
    """Fields by offset: of a C compiler and of flightgear-python 2.1.0, which read this packet
    alike.
    """
    assert len(raw) == 408
    places = {
        "version": ("I", 0),
        "longitude": ("d", 8),
        "latitude": ("d", 16),
        "altitude": ("d", 24),
    }
    places |= {
        name: ("f", at)
        for name, at in (("phi", 36), ("theta", 40), ("psi", 44), ("climb", 72), ("v_north", 76))
    }
    places |= {
        "engines": ("I", 120),
        "tanks": ("I", 284),
        "wheels": ("I", 304),
        "time": ("I", 356),
        "visibility": ("f", 364),
    }
    return {name: struct.unpack_from(f">{kind}", raw, at)[0] for name, (kind, at) in places.items()}


def test_packet_has_fields_in_places_and_units_of_flightgear() -> None:
    found = fields(packet(FLOWN, ORIGIN, 400.0, 1_700_000_000))
    north, east = local(math.degrees(found["latitude"]), math.degrees(found["longitude"]), ORIGIN)
    assert (north, east, found["altitude"]) == approx((300.0, -40.0, 450.0), abs=1e-6)
    assert (found["phi"], found["theta"], found["psi"]) == approx((0.1, 0.2, -1.0))
    assert (found["climb"], found["v_north"]) == approx((10.0, 18.52 / 0.3048))  # ft/s
    numbers = {
        name: found[name]
        for name in ("version", "engines", "tanks", "wheels", "time", "visibility")
    }
    assert numbers == {
        "version": 24,
        "engines": 1,
        "tanks": 0,
        "wheels": 3,
        "time": 1_700_000_000,
        "visibility": 20_000.0,
    }


@pytest.mark.parametrize("origin", [ORIGIN, Origin(-75.0, 179.99), Origin(0.0, 0.0)])
def test_geographic_is_inverse_of_local(origin: Origin) -> None:
    there = geographic(20_000.0, -30_000.0, origin)
    assert local(there.latitude, there.longitude, origin) == approx((20_000.0, -30_000.0), abs=1e-3)
