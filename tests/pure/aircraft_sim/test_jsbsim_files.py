# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test user models of JSBSim: the files that they name are found as JSBSim finds them.

The tests also cover what such a model may not do to the user's host.
"""

import io
import os
import zipfile
from collections.abc import Iterator
from pathlib import Path

import jsbsim
import psutil
import pytest
from tests.conftest import refusing

from aircraft_sim.jsbsim import jsbsim_trim
from aircraft_sim.jsbsim.jsbsim_aircraft import FlightCondition, aircraft_names
from aircraft_sim.jsbsim.jsbsim_files import WRITERS, model_files
from aircraft_sim.jsbsim.jsbsim_trim import trimmed_fdm
from flight_core import notes
from flight_core.outcome import FlightEnded

PACKAGE = Path(jsbsim.get_default_root_dir())
CESSNA = (PACKAGE / "aircraft" / "c172p" / "c172p.xml").read_text()
ENGINE = (PACKAGE / "engine" / "eng_io320.xml").read_text()
OUTPUT = '<output name="{}" type="CSV" rate="10"><simulation> ON </simulation></output>'


def write_model(folder: Path, line: str = "", text: str = CESSNA) -> Path:
    """Write a c172p with an additional line at the end of its model."""
    folder.mkdir(parents=True, exist_ok=True)
    model = folder / "plane.xml"
    model.write_text(text.replace("</fdm_config>", f"{line}\n</fdm_config>"))
    return model


def loaded(model: Path) -> jsbsim.FGFDMExec:
    """Load the model for a flight in this process, and run it for a moment."""
    fdm, _ = trimmed_fdm(
        FlightCondition(str(model), 46.3, 1219.2, 10_000_000), (0.0,) * 6 + (0.0, 0.0)
    )
    fdm.run_ic()
    for _ in range(20):
        fdm.run()
    return fdm


def refused(model: Path) -> str:
    """Return the sentence that refuses a model."""
    with pytest.raises(FlightEnded) as error:
        loaded(model)
    return str(error.value)


@pytest.fixture
def table(tmp_path: Path) -> Path:
    """Return a file of the user."""
    path = tmp_path / "table.csv"
    path.write_text("precious data of the user\n")
    return path


@pytest.fixture(autouse=True)
def notes_again() -> Iterator[None]:
    notes.note.cache_clear()
    yield
    notes.note.cache_clear()


@pytest.mark.parametrize("file", ["o", "o.xml", "sub/o"])
@pytest.mark.parametrize("section", ["output", "input"])
def test_section_in_another_file_is_left_out_and_said(
    section: str, file: str, table: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """JSBSim reads `o.xml` for the file "o"."""
    model = write_model(table.parent / "plane", f'<{section} file="{file}"/>')
    other = (model.parent / file).with_suffix(".xml")
    other.parent.mkdir(exist_ok=True)
    other.write_text(OUTPUT.format(table))
    before = sorted(table.parent.rglob("*"))
    loaded(model)
    assert table.read_text() == "precious data of the user\n"
    assert sorted(table.parent.rglob("*")) == before
    assert caplog.messages == [
        (
            f'note: plane.xml: left out <{section} file="{file}">: a foreign model opens no socket '
            "and writes no file"
        )
    ]


@pytest.mark.parametrize(
    "line",
    [
        OUTPUT,
        # JSBSim does not look at these.
        OUTPUT.replace("<output", '<output xmlns="urn:of-another-program"'),
    ],
)
def test_output_writes_no_file(line: str, table: Path) -> None:
    loaded(write_model(table.parent / "plane", line.replace("{}", str(table))))
    assert table.read_text() == "precious data of the user\n"


def test_output_that_an_entity_hides_writes_no_file(table: Path) -> None:
    entity = f"<!DOCTYPE fdm_config [<!ENTITY hidden '{OUTPUT.format(table)}'>]>\n"
    text = CESSNA.replace("<fdm_config", f"{entity}<fdm_config", 1)
    loaded(write_model(table.parent / "plane", "&hidden;", text))
    assert table.read_text() == "precious data of the user\n"


@pytest.mark.parametrize(
    "line",
    [
        '<input type="SOCKET" port="{}" protocol="TCP" action="ON"/>',
        '<input type="QTJSBSIM" port="{}"/>',
        '<output name="127.0.0.1" type="FLIGHTGEAR" port="{}" protocol="UDP" rate="10"/>',
    ],
)
def test_model_opens_no_socket(line: str, tmp_path: Path) -> None:
    before = {connection.fd for connection in psutil.Process().net_connections()}
    fdm = loaded(write_model(tmp_path / "plane", line.format(48620)))
    assert {connection.fd for connection in psutil.Process().net_connections()} == before
    del fdm


@pytest.mark.parametrize("place", ["system", "flight_control"])
@pytest.mark.parametrize("name", WRITERS)
def test_property_that_writes_a_file_is_refused(
    name: str, place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """JSBSim writes NAME_lin.sce and initfile.TIME.xml if a model sets these properties.

    The NAME of the model may be a path.
    """
    monkeypatch.chdir(tmp_path)
    switch = f'<property value="1">simulation/{name}</property>'
    if place == "system":
        model = write_model(tmp_path / "plane", '<system file="writes"/>')
        (model.parent / "writes.xml").write_text(f'<system name="s">{switch}</system>')
    else:
        model = write_model(
            tmp_path / "plane",
            text=CESSNA.replace("<flight_control", f"<!-- {name} --><flight_control", 1),
        )
        assert name not in model_files(model).left_out  # a comment does nothing
        switch = f'<switch name="s"><default value="1"/><output>simulation/{name}</output></switch>'
        channel = f'<channel name="c">{switch}</channel></flight_control>'
        text = CESSNA.replace("</flight_control>", channel)
        model = write_model(tmp_path / "plane", text=text)
    assert (
        f"found the property simulation/{name}, which writes a file, expected a model without it"
        in refused(model)
    )
    assert [path.name for path in tmp_path.iterdir()] == ["plane"]


def test_child_model_is_refused(tmp_path: Path) -> None:
    """A child model would be loaded with its own outputs."""
    model = write_model(tmp_path / "plane", '<child name="c172p"><location unit="IN"/></child>')
    assert "found a child model, expected none" in refused(model)


@pytest.mark.parametrize(
    "file",
    [
        "../secret",
        "sub/../../secret",
        "/etc/fonts/fonts",
    ],
)
@pytest.mark.parametrize("element", ["system", "aerodynamics", "engine"])
def test_file_outside_of_the_folder_of_the_model_is_in_no_archive(
    element: str, file: str, tmp_path: Path
) -> None:
    (tmp_path / "secret.xml").write_text("<system><key>of the user</key></system>")
    file = file.format(tmp_path)
    model = write_model(tmp_path / "plane", f'<{element} file="{file}"/>')
    (model.parent / "sub").mkdir()
    with refusing(r"found the file .*, expected one below the folder of the model, without \.\.$"):
        model_files(model)


@pytest.mark.parametrize("linked", ["file", "folder"])
def test_link_to_a_file_elsewhere_is_refused(linked: str, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    secret = tmp_path / "elsewhere" / "secret.xml"
    secret.write_text("<system><key>of the user</key></system>")
    model = write_model(tmp_path / "plane", '<system file="secret"/>')
    if linked == "file":
        (model.parent / "secret.xml").symlink_to(secret)
    else:
        (model.parent / "Systems").symlink_to(secret.parent)
    with refusing(rf"found the file secret\.xml, a link to {secret}, expected a file below"):
        model_files(model)


@pytest.mark.parametrize("folder", ["Engines", "engine"])
def test_engine_in_a_subfolder_is_the_users(folder: str, tmp_path: Path) -> None:
    """The package has an engine with the same name, of 160 hp."""
    text = CESSNA.replace('engine file="eng_io320"', 'engine file="180/eng_io320"')
    model = write_model(tmp_path / "plane", text=text)
    own = model.parent / folder / "180" / "eng_io320.xml"
    own.parent.mkdir(parents=True)
    own.write_text(ENGINE.replace("160", "111"))
    files = model_files(model)
    assert files.members[f"aircraft/plane/{folder}/180/eng_io320.xml"] == own.read_bytes()
    assert "engine/eng_io320.xml" not in files.members
    with zipfile.ZipFile(io.BytesIO(files.archive())) as archive:
        archive.extractall(tmp_path / "elsewhere")
    copy = tmp_path / "elsewhere" / "aircraft" / "plane" / "plane.xml"
    assert model_files(copy).members == files.members
    assert loaded(copy)["propulsion/engine/power-hp"] == loaded(model)["propulsion/engine/power-hp"]


def test_engine_that_an_included_propulsion_names_is_in_the_archive(tmp_path: Path) -> None:
    head, _, rest = CESSNA.partition("<propulsion>")
    body, _, tail = rest.partition("</propulsion>")
    model = write_model(tmp_path / "plane", text=f'{head}<propulsion file="Propulsion.xml"/>{tail}')
    (model.parent / "Propulsion.xml").write_text(f"<propulsion>{body}</propulsion>")
    assert {
        "aircraft/plane/Propulsion.xml",
        "engine/eng_io320.xml",
        "engine/prop_75in2f.xml",
    } <= model_files(model).members.keys()
    loaded(model)


def test_engine_directly_beside_the_model_is_not_that_of_jsbsim(tmp_path: Path) -> None:
    """JSBSim looks for an engine only in the folders of engines."""
    model = write_model(tmp_path / "plane")
    (model.parent / "eng_io320.xml").write_text(ENGINE.replace("160", "111"))
    assert model_files(model).members["engine/eng_io320.xml"].decode() == ENGINE


def loads(root: Path, aircraft: Path) -> int | None:
    """Return the number of engines of a model, or None if JSBSim does not load it."""
    jsbsim.set_logger(jsbsim_trim._Log())
    fdm = jsbsim.FGFDMExec(str(root))
    fdm.set_debug_level(0)
    fdm.set_output_path(os.devnull)
    fdm.set_aircraft_path(str(aircraft.parent))
    try:
        return (
            fdm.get_propulsion().get_num_engines() if fdm.load_model(aircraft.stem, False) else None
        )
    except jsbsim.BaseError:
        return None


@pytest.mark.parametrize("name", aircraft_names())
def test_copy_of_each_aircraft_of_the_package_loads_as_the_aircraft(
    name: str, tmp_path: Path
) -> None:
    """The copy has only the files that `model_files` finds."""
    path = PACKAGE / "aircraft" / name / f"{name}.xml"
    expected = loads(PACKAGE, path)
    if expected is not None:
        assert loads(tmp_path, model_files(path).write(tmp_path)) == expected
