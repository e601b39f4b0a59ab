"""The map of packages is that of the code; files in documents exist; imports are declared; protections have tests."""

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions

import pytest

from tests.support.docs import package_map
from tests.support.docs.readme_pages import PAGES
from tests.support.paths import ROOT

pytestmark = pytest.mark.slow

DOCUMENTS = (*PAGES, "cosim/DESIGN.md", "cosim/SCALING.md")
FILE = re.compile(r"\w+(?:/[\w.]+)+/?")


def files_in(text: str) -> set[str]:
    """The files and folders that Mermaid blocks and spans in backquotes name; those under ``vcmvsp/`` are keys of Zenoh."""
    drawings = re.findall(r"```mermaid\n(.*?)```", text, re.DOTALL)
    spans = re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    found = {path for each in (*drawings, *spans) for path in FILE.findall(each)}
    return {path for path in found if path.endswith((".py", "/")) and not path.startswith("vcmvsp/")}


def headings(text: str) -> set[str]:
    """The headings of a page, as links name them."""
    words = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", each.lower()).replace(" ", "-") for each in words}


def test_the_map_is_that_of_the_code() -> None:
    page = package_map.PAGE.read_text("utf-8")
    assert page == package_map.written(page), f"write it anew: {package_map.COMMAND}, or make docs"


@pytest.mark.parametrize("page", DOCUMENTS)
def test_files_that_are_named_exist(page: str) -> None:
    """From the top of the repository, or from the folder of the page."""
    homes = ROOT, (ROOT / page).parent
    named = files_in((ROOT / page).read_text("utf-8"))
    assert sorted(each for each in named if not any((home / each).exists() for home in homes)) == []


@pytest.mark.parametrize("page", [*DOCUMENTS, "CHANGELOG.md"])
def test_links_lead_to_a_file_and_a_heading(page: str) -> None:
    for path, heading in re.findall(r"\]\((?!http)([^)#\s]*)#?([^)\s]*)\)", (ROOT / page).read_text("utf-8")):
        target = (ROOT / page).parent / path if path else ROOT / page
        assert target.exists(), path
        assert not heading or heading in headings(target.read_text("utf-8")), f"{path}#{heading}"


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
PARTS = ("cosim", "physics", "netsim", "agents", "hardware", "src/vcmvsp")


def named(requirement: str) -> str:
    """The distribution that a requirement is about, as an index writes it."""
    return re.split(r"[^\w.-]", requirement)[0].lower().replace("_", "-")


def imported() -> set[str]:
    """Top-level modules that the product imports, anywhere in a module."""
    found = set[str]()
    for path in (path for part in PARTS for path in (ROOT / part).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                found |= {each.name.partition(".")[0] for each in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                found.add((node.module or "").partition(".")[0])
    return found - set(sys.stdlib_module_names) - {"vcmvsp"}


def test_whatever_is_imported_is_declared() -> None:
    project = PROJECT["project"]
    extras = [each for extra in project["optional-dependencies"].values() for each in extra]
    declared = {named(each) for each in (*project["dependencies"], *extras)}
    distributions = packages_distributions()
    of = {module: {named(each) for each in distributions.get(module, [])} for module in imported()}
    assert {module: names for module, names in of.items() if names and not names & declared} == {}


def test_what_is_replaced_inside_a_library_binds_its_version() -> None:
    bounds = {named(each): each for each in PROJECT["project"]["dependencies"]}
    assert "<" in bounds["viser"]
    assert "<" in bounds["websockets"]


def test_setup_leaves_what_the_user_installed_and_has_pip() -> None:
    syncs = re.findall(r"\$\(UV\) sync[^|\n]*", (ROOT / "Makefile").read_text("utf-8"))
    assert syncs
    assert all("--inexact" in each for each in syncs)
    assert "pip" in {named(each) for each in PROJECT["dependency-groups"]["dev"]}


SHOWN = {
    "scenario": ["cosim/cli/test_results_are_data.py::test_every_command_reads_data_executes_a_program_or_does_neither"],
    "results": [
        "cosim/cli/test_results_are_data.py::test_reading_executes_nothing_and_works_on_the_recording",
        "cosim/cli/test_unpacking_bombs.py::test_results_are_read_or_refused_at_little_cost",
        "cosim/studies/test_store.py::test_a_link_in_the_place_of_a_file_is_not_written_through",
    ],
    "run": [
        "cosim/hosts/test_host_code.py::test_a_folder_of_the_host_is_searched_by_file_name",
        "cosim/hosts/test_local_secret.py::test_only_who_has_the_secret_can_dial_a_run_and_its_user_needs_no_option",
        "cosim/security/test_access.py::test_a_run_under_a_name_that_its_certificate_has_not_is_refused",
    ],
    "host": [
        "cosim/hosts/test_remote_hosts.py::test_a_certificate_speaks_for_its_own_vehicles_alone",
        "cosim/security/test_acl.py::test_a_revoked_machine_is_answered_by_silence_that_has_words",
        "cosim/transport/test_endpoints.py::test_beyond_this_machine_certificates_are_a_must",
    ],
    "observer": ["cosim/hosts/test_watch.py::test_with_certificates_only_observers_watch"],
    "Foxglove stream": [
        "cosim/view/test_foxglove.py::test_what_a_client_sends_changes_nothing",
        "cosim/view/test_foxglove.py::test_an_address_beyond_loopback_is_said_to_be_open",
    ],
    "page": [
        "cosim/view/test_auth.py::test_the_page_is_given_for_the_token_and_runs_no_scripts_but_its_own",
        "cosim/view/test_auth.py::test_whatever_is_asked_only_the_token_passes",
        "cosim/view/test_auth.py::test_by_which_names_a_page_may_be_dialled",
    ],
    "robot": [
        "hardware/safety/test_sequences.py::test_no_sequence_breaks_a_law",
        "hardware/remote_robot/test_security.py::test_nobody_else_is_heard_hears_or_stands_for_it",
    ],
    "firmware": [
        "hardware/firmware/test_protocols.py::test_other_datagrams_are_refused",
        "hardware/firmware/test_flights.py::test_datagrams_of_another_protocol_are_counted_and_named",
        "hardware/firmware/test_betaflight.py::test_datagrams_of_another_version_are_counted_and_named",
    ],
    "nodes": [
        "hardware/stacks/test_ros2.py::test_a_second_publisher_and_other_types_are_refused_by_name",
        "hardware/stacks/test_crazyflie.py::test_mutated_packets_are_answered_or_refused",
    ],
    "bridge": [
        "cosim/cli/test_net.py::test_with_sudo_only_the_interfaces_are_made_with_the_rights_of_root",
        "netsim/bridge/gateways/test_ip.py::test_a_namespace_of_somebody_else_is_not_touched",
    ],
    "other users of this machine": [
        "cosim/view/test_process.py::test_no_secret_is_in_the_list_of_processes",
        "cosim/view/test_auth.py::test_half_open_sockets_keep_nobody_out",
    ],
}
"""Of each row: tests, by file and function."""


def test_every_row_has_tests() -> None:
    rows = re.findall(r"^\| \*\*(.+?)\*\*", (ROOT / "SECURITY.md").read_text("utf-8"), re.MULTILINE)
    assert rows == [*SHOWN]


@pytest.mark.parametrize("test", [test for tests in SHOWN.values() for test in tests])
def test_the_tests_of_a_row_are_there(test: str) -> None:
    file, _, name = test.partition("::")
    there = ast.parse((ROOT / "tests" / file).read_text("utf-8")).body
    assert name in {each.name for each in there if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef)}
