# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the command line: exit status, sentences and files."""

import gc
import json
import os
import re
import signal
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from importlib.metadata import version
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import Mock, patch

import pytest
import typer
from tests.conftest import REPOSITORY, invoke

from flight_analysis.closed_loop.replay import recorded_scenario
from flight_analysis.closed_loop.scenario import SCHEMAS, Scenario, scenario_yaml
from flight_analysis.closed_loop.scenario_library import LIBRARY, find_scenario
from flight_cli import cli
from flight_cli.cli import COMMANDS, VERBS, application
from flight_cli.scenarios import first_sentences
from flight_core.parameters import ParameterError
from rise_di_controller.rise_di_config import RiseDiConfig

pytestmark = pytest.mark.slow


def rise_di(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "flight_cli.cli", *arguments]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)


class Said(NamedTuple):
    """The status with which a command ended, and what it printed."""

    returncode: int
    stdout: str
    stderr: str


def said(*arguments: str) -> Said:
    """Run the entry point of `rise-di` in this process, and restore the settings of the process."""
    threshold, handler = gc.get_threshold(), signal.getsignal(signal.SIGINT)
    try:
        with (
            patch.multiple(sys, argv=["rise-di", *arguments], unraisablehook=sys.unraisablehook),
            redirect_stdout(StringIO()) as output,
            redirect_stderr(StringIO()) as errors,
            pytest.raises(SystemExit) as end,
        ):
            cli.main()
    finally:
        gc.set_threshold(*threshold)
        signal.signal(signal.SIGINT, handler)
    return Said(int(end.value.code or 0), output.getvalue(), errors.getvalue())


@pytest.fixture(scope="module")
def flown(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, subprocess.CompletedProcess[str]]:
    where = tmp_path_factory.mktemp("fly")
    return where, rise_di("fly", "osprey_gust", "--in-process", "--duration", "4", cwd=where)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has it")
def test_full_disk_behind_standard_output_is_one_sentence() -> None:
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "flight_cli.cli", "--help"]
        result = subprocess.run(
            command, stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    sentence = (
        "error: output: cannot be written (No space left on device), expected a disk with space\n"
    )
    assert (result.returncode, result.stderr) == (1, sentence)


def test_flight_ends_with_table_log_and_report(
    flown: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    where, output = flown
    assert output.returncode == 0, output.stderr
    run = (where / "runs" / "latest").resolve()
    assert {path.name for path in run.iterdir()} == {
        "metadata.yaml", "report.html", "osprey_gust.yaml", "summary.json", f"{run.name}_0.mcap",
        "airframe.yaml", "parameters.yaml", "provenance.yaml",
    }  # fmt: skip
    assert "q (deg/s)" in output.stdout
    assert f"runs/{run.name}/report.html" in output.stdout
    assert "Traceback" not in output.stderr


def test_summary_holds_what_was_flown(flown: tuple[Path, subprocess.CompletedProcess[str]]) -> None:
    summary = json.loads((flown[0] / "runs" / "latest" / "summary.json").read_text())
    assert (summary["scenario"], summary["outcome"]["sentence"], summary["duration"]) == (
        "osprey_gust",
        "completed",
        4.0,
    )
    assert summary["errors"]["q"]["gust"] == {"rms": None, "max": None}  # the gusts come later
    assert 0 < summary["errors"]["q"]["calm"]["rms"] < 1e-3
    assert (summary["ticks"]["ticks"], summary["ticks"]["without_new_y"]) == (401, 0)


def test_log_has_the_scenario_that_flew(
    flown: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    """The log has the scenario with the duration of the command.

    So it can be flown again with the scenario beside the log.
    """
    run = flown[0] / "runs" / "latest"
    assert scenario_yaml(recorded_scenario(run)) == scenario_yaml(find_scenario("osprey_gust", 4.0))


def test_report_is_one_page_that_needs_no_network(
    flown: tuple[Path, subprocess.CompletedProcess[str]],
) -> None:
    page = (flown[0] / "runs" / "latest" / "report.html").read_text()
    assert 'src="http' not in page
    assert "the root of the mean square" in page  # the word rms is explained
    assert "periods without a new y" in page
    # First comes how the flight went, and what the aircraft did; the tables follow.
    assert page.index('class="verdict') < page.index("Output y over the reference y_m</h2>")
    assert page.index("Output y over the reference y_m</h2>") < page.index("<table")


def test_json_is_all_that_is_printed(tmp_path: Path) -> None:
    process = rise_di("fly", "--in-process", "--duration", "0.5", "--json", cwd=tmp_path)
    assert json.loads(process.stdout)["duration"] == 0.5
    assert process.stderr == ""


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (["fly", "nowhere"], "error: scenario: found 'nowhere', expected one of"),
        (
            ["fly", "--duration", "-1"],
            "error: flight.duration: found -1.0, expected greater than 0",
        ),
        (
            ["fly", "--set", "controler.k_g=1"],
            "error: --set: found 'controler.k_g=1', expected a parameter of the scenario and its",
        ),
        (
            ["fly", "--set", "controller.k_g"],
            "error: --set: found 'controller.k_g', expected a parameter of the scenario and",
        ),
        (["report", "nowhere"], "error: nowhere: found no such file or folder"),
        (
            ["fly", "osprey_srvo"],
            "error: scenario: found 'osprey_srvo', expected osprey_servo perhaps, or another of",
        ),
    ],
)
def test_bad_input_is_one_sentence_and_status_2(
    arguments: list[str], sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    process = said(*arguments)
    assert process.returncode == 2
    assert process.stderr.startswith(sentence)
    assert ("the section is controller perhaps" in process.stderr) == ("controler." in sentence)
    assert len(process.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_flight_with_set_parameters_has_them_in_its_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    no_design = Mock(side_effect=ParameterError("the design is not the subject"))
    monkeypatch.setattr("flight_design.learning.scenario_learner.selected_observer", no_design)
    settings = (
        "--set",
        "controller.k_g=2.5",
        "--set",
        "controller.learn.window=40",
        "--set",
        "flight.duration=0.2",
    )
    process = said("fly", "osprey_learn", "--in-process", *settings)
    assert process.returncode == 0, process.stderr
    scenario = recorded_scenario(tmp_path / "runs" / "latest")
    expected = find_scenario("osprey_learn").rise_di().learn
    assert expected is not None
    assert (scenario.flight.duration, scenario.rise_di().k_g) == (0.2, 2.5)
    assert scenario.rise_di().learn == expected.model_copy(update={"window": 40.0})


def test_scenario_file_may_lie_anywhere_and_wrong_sign_ends_flight_when_it_diverges(
    tmp_path: Path, osprey_gust: Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text = osprey_gust.path.read_text()
    (tmp_path / "mine.yaml").write_text(text.replace("D: [1, 1, 1, 1]", "D: [-1, 1, 1, 1]"))
    process = said("fly", "mine.yaml", "--in-process")
    assert process.returncode == 3
    assert "outcome: diverged at t = " in process.stdout
    assert (tmp_path / "runs" / "latest").resolve().name.endswith("-mine")


def test_command_whose_python_package_is_missing_says_what_installs_it(tmp_path: Path) -> None:
    (tmp_path / "jax.py").write_text("raise ModuleNotFoundError('No module named jax', name='jax')")
    # -m puts the working folder first
    process = rise_di("campaign", "osprey_servo", "--aircraft", "1", cwd=tmp_path)
    assert process.returncode == 2
    sentence = "error: rise-di campaign: the Python package jax is not installed: make setup-all"
    assert process.stderr.splitlines()[-1] == sentence
    assert "Traceback" not in process.stderr


def test_device_that_jax_lacks_is_one_sentence_without_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """JAX refuses a device in a process that has not found its devices yet.

    `compare` asks JAX as well.
    """
    words = [sys.executable, "-m", "flight_cli.cli", "campaign", "osprey_servo", "--aircraft", "1"]
    environment = {**os.environ, "JAX_PLATFORMS": "nonsense"}
    process = subprocess.run(
        words, cwd=tmp_path, capture_output=True, text=True, check=False, env=environment
    )
    assert process.returncode == 2
    assert process.stderr.splitlines()[-1].startswith("error: JAX_PLATFORMS: found 'nonsense' (")
    assert "Traceback" not in process.stderr
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("flight_campaign.batch.device.is_cpu", Mock(side_effect=RuntimeError))
    compared = said("compare", "osprey_servo", "--aircraft", "1")
    assert compared.stderr.startswith("error: JAX_PLATFORMS: found '")
    assert list(tmp_path.iterdir()) == []


def test_folder_of_runs_that_is_not_utf_8_is_refused_before_anything_is_made(
    tmp_path: Path,
) -> None:
    words = [
        sys.executable,
        "-m",
        "flight_cli.cli",
        "fly",
        "osprey_gust",
        "--in-process",
        "--duration",
        "0.1",
        "--runs",
    ]
    process = subprocess.run(
        [*map(os.fsencode, words), b"r\xff"], cwd=tmp_path, capture_output=True, check=False
    )
    assert process.returncode == 2
    assert re.fullmatch(
        rb"error: --runs: found .*udcff', expected a folder with a name in UTF-8.*\n",
        process.stderr,
    )
    assert list(tmp_path.iterdir()) == []


def test_the_version_is_that_of_the_package(tmp_path: Path) -> None:
    assert rise_di("--version", cwd=tmp_path).stdout == f"rise-di {version('rise-di')}\n"


def command_of(*words: str) -> Any:
    """Return a command, or a verb of it."""
    command: Any = typer.main.get_command(application(words[:1]))
    for word in words:
        command = command.commands[word]
    return command


def options_of(*words: str) -> list[Any]:
    """Return the options of a command or of a verb."""
    return [each for each in command_of(*words).params if each.param_type_name == "option"]


EVERY_COMMAND: list[tuple[str, ...]] = [(name,) for name in COMMANDS if name not in VERBS]
EVERY_COMMAND += [(name, verb) for name, verbs in VERBS.items() for verb in verbs]


def test_commands_are_few_and_so_are_options_beside_the_panel_of_rare_ones() -> None:
    assert len(COMMANDS) <= 20
    for words in EVERY_COMMAND:
        assert sum(each.rich_help_panel is None for each in options_of(*words)) <= 10, words


def test_option_is_a_name_in_small_letters_joined_by_hyphens() -> None:
    """An option has lower-case letters and hyphens, except for Ixx and the like.

    Those are the symbols of the field. Two options also have a short form, as in other tools.
    """
    for words in EVERY_COMMAND:
        spellings = [spelling for each in options_of(*words) for spelling in each.opts]
        letters = {text for text in spellings if not re.fullmatch(r"--[a-zI][a-z0-9-]*", text)}
        assert letters <= {"-q", "-v"}


def test_what_a_command_writes_is_its_output() -> None:
    """A user who knows one command expects --output in the next one, too."""
    for name in (
        "airframes",
        "compare",
        "export",
        "gains select",
        "identify jsbsim",
        "identify log",
        "identify bridge",
        "import",
        "learn",
        "network",
    ):
        assert any("--output" in option.opts for option in options_of(*name.split())), name


@pytest.mark.parametrize(
    "words",
    [
        "fly --runs there --duration 3 --composed --use-sim-time --learn --fence a.plan",
        "fly --route a.gpx --origin 47.4,8.5 --altitude 400 --simplify 50 --line 2",
        "gains select osprey --rate 100 --y-rate 50 --margin 0.04 --page a.html --accept",
        "gains select osprey --px4 a.params --write g.yaml",
        "gains select osprey --phase-margin 45 --seed 2 --samples 20 --output g.yaml --json",
        "gains guarantee osprey --late 0.01 --worst folder",
        "identify log a --airframe osprey --scenario osprey_gust --delay 0 --refly --margin 0.03",
        "identify bridge px4 --amplitude 0.4 --phase-margin 40 --link-delay 0.1 --output folder",
        "campaign --runs there --workers 2 --aircraft 9 --seed 3 --wind published --chunk 2",
        "compare --wind published --gains tuned.yaml --turbulence-seed 4 --output law.yaml",
        "export osprey_servo --rate 80 --output code --duration 20 --seed 2 --samples 8 --drawn 9",
        "airframes a.yaml --output here --speed 20 --mass 3 --Ixx 1 --thrust --name own --force",
        "report --output folder --width 88mm --channels q,V --page both.html --json",
        "watch --runs there --remap y:=/sensors/y --background a.geojson --origin 1,2 --real",
        "import log.bin --map px4 --output folder",
        "learn runs/latest --output model.yaml --set controller.learn.window=40",
        "guide route.plan --origin 47.4,8.5 --altitude 400",
        "network --peers 10.0.0.1 --output profile.xml",
        "play runs/latest --rate 2",
    ],
)
def test_natural_options_are_taken(words: str) -> None:
    name, *rest = words.split()
    verb = [rest.pop(0)] if name in VERBS else []
    command_of(name, *verb).make_context(name, rest)


KEY = ", or set a key of the scenario, --set SECTION.KEY=VALUE"


@pytest.mark.parametrize(
    "words, mend",
    [
        ("gains select osprey --rates 3", "did you mean --rate?"),
        ("gains select osprey --y_rate 50", "did you mean --y-rate?"),
        ("gains select osprey --phase_margin=45", "did you mean --phase-margin?"),
        ("campaign --run x", "did you mean --runs?"),
        ("campaign --worker 3", "did you mean --workers?"),
        ("campaign --jobs 3", "did you mean --workers?"),
        ("campaign --samples 3", "did you mean --aircraft?"),
        ("identify log a --link-delay 1", "rise-di identify log --help lists them"),
        ("airframes --ixx 3", "did you mean --Ixx?"),
        ("report --html a.html", "did you mean --page?"),
        ("import log.bin --out bag", "did you mean --output?"),
        ("play runs/latest --speed 2", "did you mean --rate?"),
        ("gains select osprey --set rate=100", "rise-di gains select --help lists them"),
        ("fly --run x", "did you mean --runs?"),
        ("fly --out x", "did you mean --runs?"),
        ("fly --scenario osprey_gust", "give it without a name, rise-di fly SCENARIO"),
        # A key of the scenario is never taken for --send, which commands an autopilot.
        ("fly --seed 3", f"rise-di fly --help lists them{KEY}"),
        ("fly --law rise", f"rise-di fly --help lists them{KEY}"),
        ("replay --k-g 2", f"rise-di replay --help lists them{KEY}"),
    ],
)
def test_other_option_is_refused_with_its_mend(words: str, mend: str) -> None:
    error = invoke(*words.split()).exception
    option = next(word for word in words.split() if word.startswith("--")).partition("=")[0]
    name, verb, *_ = words.split()
    command = f"{name} {verb}" if name in VERBS else name
    assert str(error) == f"{option} is no option of rise-di {command}: {mend}"


@pytest.mark.parametrize(
    "words, refusal",
    [
        ("flyy", "flyy is no command of rise-di: did you mean fly?"),
        ("scenario", "scenario is no command of rise-di: did you mean scenarios?"),
        ("xyzzy", "xyzzy is no command of rise-di: rise-di --help lists them"),
        ("--verison", "--verison is no option of rise-di: did you mean --version?"),
        ("fly -x", "-x is no option of rise-di fly: rise-di fly --help lists them"),
        ("fly --duration", "rise-di fly: option '--duration' requires an argument; rise-di fly"),
        ("fly a b", "rise-di fly: got unexpected extra argument"),
        ("export", "rise-di export: missing argument 'scenario'; rise-di export --help shows"),
        ("fly -q -v", "--quiet beside it, expected one of the two"),
    ],
)
def test_every_refusal_of_words_is_one_line_in_one_form(words: str, refusal: str) -> None:
    command = said(*words.split())
    assert command.returncode == 2
    assert command.stderr.startswith("error: ")
    assert refusal in command.stderr
    assert len(command.stderr.splitlines()) == 1
    assert command.stdout == ""


@pytest.mark.parametrize(
    "words, same", [("-h", "--help"), ("help", "--help"), ("fly -h", "fly --help")]
)
def test_help_is_found_by_each_usual_word(words: str, same: str) -> None:
    asked, expected = (said(*text.split()) for text in (words, same))
    assert (asked.returncode, asked.stdout) == (0, expected.stdout)
    if words == "fly -h":
        assert said("help", "fly").stdout == expected.stdout


def test_quiet_flight_prints_its_headline_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    process = said("fly", "osprey_gust", "--in-process", "--duration", "0.5", "-q")
    assert process.stdout == "completed\n", process.stderr
    assert process.stderr == ""


@pytest.mark.parametrize(
    "comment, expected",
    [
        (["A gust of 1.5 m/s,", "then a turn.", "More."], "A gust of 1.5 m/s, then a turn."),
        (["One line without a stop"], "One line without a stop"),
        (["One. And another", "that goes on.", "More."], "One. And another that goes on."),
        (["No stop", "", "Another paragraph."], "No stop"),
        ([], ""),
    ],
)
def test_sentences_of_a_scenario_are_whole(comment: list[str], expected: str) -> None:
    head = ["SPDX-License-Identifier: Apache-2.0", "", *comment]
    text = "\n".join([*(f"# {line}".rstrip() for line in head), "/**/flight:", "  # no head."])
    assert first_sentences(text) == expected


def test_no_sentence_of_a_shipped_scenario_breaks_off() -> None:
    listed = json.loads(invoke("scenarios", "--json").output)
    assert [row["name"] for row in listed if not row["flies"].endswith(".")] == []


@pytest.mark.parametrize("words", ["campaign osprey_servo --runs 10", "fly --runs=3"])
def test_number_of_runs_is_no_folder(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A number in place of the folder for the logs is refused.

    It had created a folder of this name, and had flown the whole campaign.
    """
    monkeypatch.chdir(tmp_path)
    assert "expected the folder for the logs" in str(invoke(*words.split()).exception)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "words, refusal",
    [
        ("gains select osprey --observer --margin 0.9", "--margin: found 0.9, expected 0 to 0.5 s"),
        ("gains select osprey --rate nan", "--rate: found nan, expected 1 to 1000 Hz"),
        ("gains guarantee osprey --late 9", "--late: found 9.0, expected 0 to 0.5 s"),
        (
            "gains guarantee osprey --saturation flap",
            "--saturation: found flap, expected an input: elevator, aileron, rudder, thrust",
        ),
        (
            "gains guarantee osprey --saturation rudder --late 0.01",
            "--saturation: found --late 0.01 beside it, expected u in time",
        ),
        (
            "identify log . --airframe osprey --margin 0.1",
            "--margin: found 0.1, expected --refly beside it",
        ),
        (
            "identify jsbsim c172p --speed 0 --altitude 9",
            "--speed: found 0.0, expected above 0 m/s",
        ),
        ("campaign --score q", "--score: found 'q', expected a name and a number: q=0.02"),
        ("fly --in-process --composed", "--in-process: found --composed too, expected one of the"),
        ("fly --in-process --line 2", "--line: found no --route, expected the file of a route"),
        ("fly --set runs=x", "--set: found 'runs=x', expected a parameter of the scenario"),
        ("fly --set k_g=2", "--set: found 'k_g=2', expected the section too: controller.k_g=2"),
        ("fly --set duration=7", "--set: found 'duration=7', expected the section too: flight."),
        ("fly --set sign=x", "--set: found 'sign=x', expected the section too: controller.sign=x"),
    ],
)
def test_refusal_names_the_option_as_it_is_typed(words: str, refusal: str) -> None:
    assert str(invoke(*words.split()).exception).startswith(refusal)


@pytest.mark.parametrize(
    "words, expected",
    [
        ("gains select osprey --scenario osprey_s", "osprey_servo"),
        ("replay runs/latest --set controller.k_g=2 --scenario osprey_s", "osprey_servo"),
        ("fly osprey_s", "osprey_servo"),
        ("fly osprey_servo --ru", "--runs"),
        ("fly --duration 5 osprey_s", "osprey_servo"),
        ("fly osprey_servo --set controller.k_", "controller.k_g="),
        ("fly --set aircraft.sensors.no", "aircraft.sensors.noise="),
        ("campaign --wo", "--workers"),
        ("gains check os", "osprey"),
        ("gains sel", "select"),
        ("identify bri", "bridge"),
        ("identify bridge px", "px4"),
        ("airframes osprey x", "x8_elevons"),
        ("identify log runs/latest --airframe os", "osprey"),
        ("check px4", "px4"),
        ("fly osprey_servo --bridge px4", "px4"),
        ("import flight.bin --map px4", "px4"),
        ("campaign --runs there --engine th", "threads"),
        ("campaign --workers 2 --distribution co", "corners"),
        ("compare --turbulence-seed 3 --wind pu", "published"),
        ("compare --laws r", "rise"),
        ("compare osprey_servo --laws rise,p", "rise,pi"),
        ("guide ho", "hold"),
        ("guide altitude=1300 head", "heading="),
    ],
)
def test_shell_completes_after_each_option(
    words: str, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("_RISE_DI_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", f"rise-di {words}")
    monkeypatch.setenv("COMP_CWORD", str(len(words.split())))
    shown = said()
    assert expected in shown.stdout.split(), shown.stderr


def test_failing_plugin_of_jax_is_one_sentence(tmp_path: Path) -> None:
    """A plugin for GPUs fails on a host without one, and JAX logs its traceback."""
    plugin = tmp_path / "jax_plugins" / "xla_broken" / "__init__.py"
    plugin.parent.mkdir(parents=True)
    plugin.write_text("def initialize():\n    raise RuntimeError('no library')\n")
    process = subprocess.run(
        [sys.executable, "-c", "from flight_campaign.engines import require_jax; require_jax()"],
        env={**os.environ, "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"},
        capture_output=True,
        text=True,
        check=True,
    )
    sentence = "warning: a plugin of JAX is left out (no library): the other devices fly"
    assert process.stderr.splitlines() == [sentence]


def test_scenarios_are_listed_with_their_sentence_aircraft_and_law() -> None:
    listed = json.loads(invoke("scenarios", "--json").output)
    assert [row["name"] for row in listed] == sorted(path.stem for path in LIBRARY.glob("*.yaml"))
    (servo,) = (row for row in listed if row["name"] == "osprey_servo")
    assert (servo["aircraft"], servo["law"]) == ("osprey", "rise_di")
    assert servo["flies"].startswith("Commands on every channel and two gusts")
    answer = invoke("scenarios", "osprey_gust")
    assert "osprey_gust" in answer.output
    assert "osprey_route" not in answer.output


def test_help_shows_the_names_of_entries_whole() -> None:
    """Rich takes brackets for markup, and A[q,alpha] was shown as A."""
    words = " ".join(invoke("gains", "check", "--help").output.replace("│", " ").split())
    assert "'A[q,alpha]=0.6', or of an actuator '1/lag[elevator]=0.3'" in words


def test_every_command_of_help_has_help_of_own() -> None:
    for name in COMMANDS:
        answer = invoke(name, "--help", prog_name="rise-di")
        assert answer.exit_code == 0, name
        assert f"Usage: rise-di {name}" in answer.stdout
    listed = said("--help").stdout
    assert all(name in listed for name in COMMANDS)
    for name, verbs in VERBS.items():
        for verb in verbs:
            assert f"Usage: rise-di {name} {verb}" in said("help", name, verb).stdout


def test_interrupt_inside_destructor_ends_command_without_traceback() -> None:
    code = """
import signal, time
from flight_cli import cli

class Interrupting:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)

def command(prog_name):
    Interrupting()
    time.sleep(60.0)

cli.application = lambda words: command
cli.main()
"""
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "")


@pytest.mark.parametrize("error", ["ImportError", "TypeError"])
@pytest.mark.parametrize(
    "cause, status, words", [("KeyboardInterrupt()", 130, ""), ("OSError()", 1, "Traceback")]
)
def test_interrupt_in_a_module_in_c_ends_command_without_traceback(
    error: str, cause: str, status: int, words: str
) -> None:
    """pybind11, and with it rclpy, turns a KeyboardInterrupt into other errors.

    It becomes an ImportError while a module loads, and a TypeError in a callback. An error with
    another cause is printed.
    """
    code = f"""
from flight_cli import cli

def command(prog_name):
    raise {error}("initialization failed") from {cause}

cli.application = lambda words: command
cli.main()
"""
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert (ended.returncode, ended.stdout) == (status, "")
    assert words in ended.stderr if words else ended.stderr == ""


def test_keys_of_the_first_page_are_keys_of_a_scenario() -> None:
    page = (REPOSITORY / "docs" / "get-started.md").read_text()
    keys = re.findall(r"^\| `(\w+\.\w+)` \|", page.partition("15 keys")[2], re.MULTILINE)
    assert len(keys) == 15
    for key in keys:
        section, _, name = key.partition(".")
        models = [SCHEMAS[section], RiseDiConfig] if section == "controller" else [SCHEMAS[section]]
        assert any(name in model.model_fields for model in models), key  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    "words, nice",
    [
        ("watch", True),
        ("watch runs/latest --text", True),
        ("watch --control", False),
        ("watch runs/latest --namespace uav1 --control", False),
        ("watch --real", False),
        ("fly osprey_servo", False),
        ("guide home", False),
    ],
)
def test_page_that_commands_a_flight_runs_at_normal_priority(
    words: str, nice: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []
    monkeypatch.setattr(os, "nice", lambda by: calls.append("nice"))
    monkeypatch.setattr(os, "sched_setscheduler", lambda *_: calls.append("batch"))
    monkeypatch.setattr(cli, "application", lambda words: lambda prog_name: None)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.setattr(sys, "unraisablehook", None)
    monkeypatch.setattr(sys, "argv", ["rise-di", *words.split()])
    cli.main()
    assert calls == (["nice", "batch"] if nice else [])
