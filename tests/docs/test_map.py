"""The map of packages agrees with the code; files in documents exist; imports are declared; protections have tests."""

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
    """Files and folders named in Mermaid blocks and in backquotes; those under ``vcmvsp/`` are keys of Zenoh."""
    drawings = re.findall(r"```mermaid\n(.*?)```", text, re.DOTALL)
    spans = re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    found = {path for each in (*drawings, *spans) for path in FILE.findall(each)}
    return {path for path in found if path.endswith((".py", "/")) and not path.startswith("vcmvsp/")}


def headings(text: str) -> set[str]:
    """The headings of a page, as anchors of links."""
    words = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", each.lower()).replace(" ", "-") for each in words}


def test_the_map_agrees_with_the_code() -> None:
    page = package_map.PAGE.read_text("utf-8")
    assert page == package_map.page_with_map(page), f"write it anew: {package_map.COMMAND}, or make docs"


@pytest.mark.parametrize("page", DOCUMENTS)
def test_named_files_exist(page: str) -> None:
    """Relative to the repository, or to the folder of the page."""
    homes = ROOT, (ROOT / page).parent
    named = files_in((ROOT / page).read_text("utf-8"))
    assert sorted(each for each in named if not any((home / each).exists() for home in homes)) == []


@pytest.mark.parametrize("page", [*DOCUMENTS, "CHANGELOG.md"])
def test_targets_of_links_exist(page: str) -> None:
    for path, heading in re.findall(r"\]\((?!http)([^)#\s]*)#?([^)\s]*)\)", (ROOT / page).read_text("utf-8")):
        target = (ROOT / page).parent / path if path else ROOT / page
        assert target.exists(), path
        assert not heading or heading in headings(target.read_text("utf-8")), f"{path}#{heading}"


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
PARTS = ("cosim", "physics", "netsim", "agents", "hardware", "src/vcmvsp")


def named(requirement: str) -> str:
    """Name of the distribution in a requirement, as an index writes it."""
    return re.split(r"[^\w.-]", requirement)[0].lower().replace("_", "-")


def imported_modules() -> set[str]:
    """Top-level modules that the product imports, at any place in a module."""
    found = set[str]()
    for path in (path for part in PARTS for path in (ROOT / part).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                found |= {each.name.partition(".")[0] for each in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                found.add((node.module or "").partition(".")[0])
    return found - set(sys.stdlib_module_names) - {"vcmvsp"}


def test_all_imports_are_declared() -> None:
    project = PROJECT["project"]
    extras = [each for extra in project["optional-dependencies"].values() for each in extra]
    declared = {named(each) for each in (*project["dependencies"], *extras)}
    distributions = packages_distributions()
    of = {module: {named(each) for each in distributions.get(module, [])} for module in imported_modules()}
    assert {module: names for module, names in of.items() if names and not names & declared} == {}


def test_libraries_with_replaced_internals_have_an_upper_bound() -> None:
    bounds = {named(each): each for each in PROJECT["project"]["dependencies"]}
    assert "<" in bounds["viser"]
    assert "<" in bounds["websockets"]


def test_setup_keeps_packages_of_the_user_and_includes_pip() -> None:
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
        "cosim/hosts/test_local_secret.py::test_only_the_secret_admits_to_a_run_and_its_user_needs_no_option",
        "cosim/security/test_access.py::test_a_run_under_a_name_without_certificate_is_refused",
    ],
    "host": [
        "cosim/hosts/test_remote_hosts.py::test_a_certificate_is_valid_only_for_its_vehicles",
        "cosim/security/test_acl.py::test_a_revoked_machine_gets_no_answer_but_a_reason",
        "cosim/transport/test_endpoints.py::test_beyond_this_machine_certificates_are_a_must",
    ],
    "observer": ["cosim/hosts/test_watch.py::test_with_certificates_only_observers_watch"],
    "Foxglove stream": [
        "cosim/view/test_foxglove.py::test_a_client_gets_the_recorded_messages_and_changes_nothing",
        "cosim/view/test_foxglove.py::test_an_address_beyond_loopback_gives_a_caution",
    ],
    "page": [
        "cosim/view/test_auth.py::test_the_page_requires_the_token_and_runs_only_its_own_scripts",
        "cosim/view/test_auth.py::test_only_requests_with_the_token_pass",
        "cosim/view/test_auth.py::test_host_names_of_a_page",
    ],
    "robot": [
        "hardware/safety/test_sequences.py::test_no_sequence_breaks_a_law",
        "hardware/remote_robot/test_security.py::test_others_cannot_send_receive_or_replace_it",
    ],
    "firmware": [
        "hardware/firmware/test_protocols.py::test_other_datagrams_are_refused",
        "hardware/firmware/test_flights.py::test_data_of_another_protocol_are_counted_and_named",
    ],
    "nodes": [
        "hardware/stacks/test_ros2.py::test_a_second_publisher_and_other_types_are_refused_by_name",
        "hardware/stacks/test_crazyflie.py::test_mutated_packets_are_answered_or_refused",
    ],
    "bridge": [
        "cosim/cli/test_net.py::test_with_sudo_only_the_interfaces_are_made_as_root",
        "netsim/bridge/gateways/test_ip.py::test_a_foreign_namespace_is_not_changed",
    ],
    "other users of this machine": [
        "cosim/view/test_process.py::test_no_secret_is_in_the_list_of_processes",
        "cosim/view/test_auth.py::test_half_open_sockets_block_no_page",
    ],
}
"""Tests of each row, by file and function."""


def test_every_row_has_tests() -> None:
    rows = re.findall(r"^\| \*\*(.+?)\*\*", (ROOT / "SECURITY.md").read_text("utf-8"), re.MULTILINE)
    assert rows == [*SHOWN]


@pytest.mark.parametrize("test", [test for tests in SHOWN.values() for test in tests])
def test_the_tests_of_a_row_exist(test: str) -> None:
    file, _, name = test.partition("::")
    there = ast.parse((ROOT / "tests" / file).read_text("utf-8")).body
    assert name in {each.name for each in there if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef)}
