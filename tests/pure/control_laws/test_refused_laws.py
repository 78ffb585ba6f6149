# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test which sections of laws and observers a controller refuses, and test their digests."""

from importlib.metadata import EntryPoint, EntryPoints
from typing import Any

import numpy as np
import pytest
from tests.conftest import REPOSITORY
from tests.other_laws import COMMON
from tests.pure.control_laws.each_law import (
    NAMES,
    OBSERVED,
    controller,
    sections,
)

from control_laws.catalogue import LAWS
from flight_core.parameters import ParameterError
from rise_di_controller import laws
from rise_di_controller.laws import AnyLaw
from rise_di_controller.params import ControllerConfig

pytestmark = pytest.mark.usefixtures("example_law")


def refused(sentence: str, values: dict[str, Any]) -> None:
    with pytest.raises(ParameterError) as error:
        AnyLaw.validate_mapping(values, "controller")
    assert str(error.value).startswith(sentence), str(error.value)
    assert len(str(error.value).splitlines()) == 1


def test_page_names_every_registered_law_and_parameters() -> None:
    page = (REPOSITORY / "docs" / "laws.md").read_text()
    for name in laws.names():
        own_section = (
            []
            if name in {"lqi", "indi", "mackunis"}
            else set(laws.schema(name).model_fields) - set(ControllerConfig.model_fields)
        )
        for word in (name, *own_section):
            assert f"`{word}`" in page, word


def test_unregistered_law_refused() -> None:
    """The refusal lists the registered laws."""
    registered = "excitation, indi, l1, lqg, lqi, mackunis, pi, pid, rise_di"
    refused(
        f"controller.law: found 'adrc', expected a registered law: {registered}",
        COMMON | {"law": "adrc"},
    )
    refused("controller.law: found ['pi'], expected a registered law", COMMON | {"law": ["pi"]})


def test_law_of_more_than_y_refused() -> None:
    topics = "expected a law of y and y_m: the topics have no more"
    refused(
        f"controller.law: found 'lqi', which needs the full state, {topics}",
        COMMON | {"law": "lqi"},
    )
    refused(
        f"controller.law: found 'indi', which needs the positions of the actuators, {topics}",
        COMMON | {"law": "indi"},
    )
    refused(
        f"controller.law: found 'mackunis', which needs a derivative of y, {topics}",
        COMMON | {"law": "mackunis"},
    )


def test_compared_laws_are_those_that_a_scenario_names() -> None:
    """All registered laws are compared, except two.

    The excitation controls nothing, and `pid` belongs to the package of an example.
    """
    assert {law.law for law in LAWS.values()} == {*laws.names()} - {"excitation", "pid"}


def test_entry_point_that_is_no_law_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    values = {
        "absent": ["absent_package.law:Parameters"],
        "function": ["control_laws.pi:params_of"],
        "twice": ["control_laws.pi:PiConfig", "control_laws.l1:L1Config"],
    }
    entries = EntryPoints(
        EntryPoint(name, value, laws.GROUP) for name, targets in values.items() for value in targets
    )
    monkeypatch.setattr(laws, "_registered", lambda: entries)
    for name, sentence in {
        "absent": "found 'absent', which cannot be loaded (No module named 'absent_package'), "
        "expected an installed package",
        "function": "found 'function', registered as <function params_of",
        "twice": "found 'twice', registered as control_laws.l1:L1Config and as "
        "control_laws.pi:PiConfig, expected one",
    }.items():
        refused(f"controller.law: {sentence}", COMMON | {"law": name})


def test_a_parameter_of_another_law_is_refused() -> None:
    pi = sections()["pi"]
    refused(
        "controller.beta: found a parameter of rise_di, expected keys of the law pi: K, Lambda",
        pi | {"beta": [1.0] * 4},
    )
    refused("controller.K: unknown key", sections()["rise_di"] | {"K": [1.0] * 4})


@pytest.mark.parametrize(
    "name, changes, sentence",
    [
        (
            "pi",
            {"K": [1.0] * 3},
            "controller.K: found 3 values, expected 4, one for each of q, p, r, V",
        ),
        ("l1", {"Omega": [1.0] * 16}, "controller.Omega: found a matrix without a D ("),
        (
            "pid",
            {"filter_time": [0.0] * 4},
            "controller.filter_time[0]: found 0.0, expected greater than 0",
        ),
        (
            "lqg, observer",
            {"observer": None},
            (
                "controller.observer: found none, expected a section: the observer is the feedback "
                "of lqg"
            ),
        ),
    ],
)
def test_invalid_parameter_of_law_refused(
    name: str, changes: dict[str, Any], sentence: str
) -> None:
    refused(sentence, sections()[name] | changes)


def test_an_invalid_observer_is_refused() -> None:
    values = sections()["pi, observer"]
    observer = values["observer"]
    states = list(observer["states"])
    s = len(observer["states"])

    def observed(**changes: Any) -> dict[str, Any]:
        return values | {"observer": observer | changes}

    refused(
        "controller.observer: found no feedforward beside it, expected the section feedforward",
        values | {"feedforward": None},
    )
    refused(
        f"controller.observer.Phi: found {s} values, expected {s * s}: {s} rows of {s}",
        observed(Phi=[1.0] * s),
    )
    others = [states[1], states[0], *states[2:]]
    refused("controller.observer.states: found x.alpha, x.V, x.q", observed(states=others))
    unstable = np.reshape(observer["Phi"], (s, s)) + 2.0 * np.eye(s)
    refused(
        "controller.observer.L: found a spectral radius of ",
        observed(Phi=unstable.ravel().tolist()),
    )
    refused(
        "controller.observer.F: found a spectral radius of ",
        observed(F=[-3.0 * gain for gain in observer["F"]]),
    )
    refused(
        "controller.observer.margin: found a nominal loop that is unstable with u ",
        observed(margin=0.2),
    )


def test_unfit_feedforward_refused() -> None:
    """A nominal model with another D or with a zero in the right half plane is refused."""
    values = sections()["pi, observer"]
    B = np.reshape(values["feedforward"]["B"], (-1, 4))
    negative = values | {"feedforward": values["feedforward"] | {"B": (-B).ravel().tolist()}}
    refused(
        "controller.feedforward.B: found a C B with D = [-1, -1, -1, -1], expected D = [1, 1, "
        "1, 1]",
        negative,
    )
    A = np.reshape(values["feedforward"]["A"], (len(B), len(B))).copy()
    hidden = values["feedforward"]["states"].index("alpha")
    A[hidden, hidden] += 20.0  # w diverges by itself
    growing = values | {"feedforward": values["feedforward"] | {"A": A.ravel().tolist()}}
    refused("controller.feedforward.A: found zero dynamics with an eigenvalue at ", growing)


def test_digest_depends_on_law() -> None:
    """A log of a version without the key `law` keeps its digest."""
    digests = {name: controller(name).digest() for name in (*NAMES, *OBSERVED)}
    assert len(set(digests.values())) == len(digests)
    section = AnyLaw.validate_mapping(sections()["rise_di"] | {"law": "rise_di"}, "controller")
    without_name = {key: value for key, value in sections()["rise_di"].items() if key != "law"}
    assert section.digest() == AnyLaw.validate_mapping(without_name, "controller").digest()
