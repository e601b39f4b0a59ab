"""Each row of the table of `SECURITY.md` has tests that show its protection."""

import ast
import re

import pytest

from tests.support.paths import ROOT

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
    "page": [
        "cosim/view/test_auth.py::test_the_page_is_given_for_the_token_and_runs_no_scripts_but_its_own",
        "cosim/view/test_auth.py::test_whatever_is_asked_only_the_token_passes",
        "cosim/view/test_auth.py::test_by_which_names_a_page_may_be_dialled",
    ],
    "robot": [
        "hardware/safety/test_ground_laws.py::test_the_body_never_crosses_the_fence_and_its_margin",
        "hardware/remote_robot/test_security.py::test_nobody_else_is_heard_hears_or_stands_for_it",
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
