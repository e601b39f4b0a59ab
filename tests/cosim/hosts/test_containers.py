"""Container files, without containers: their command lines are valid, and run together as processes."""

import json
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

import vcmvsp
from tests.support.cosim.command_line import vcmvsp_command
from tests.support.cosim.run_processes import Stage, exit_of, staged
from tests.support.paths import ROOT
from vcmvsp.cosim.cli import app
from vcmvsp.cosim.hosts import ssh_hosts

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

DEPLOY = ROOT / "cosim" / "deploy"
README = (DEPLOY / "README.md").read_text()
COMPOSE: dict[str, Any] = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
MANIFESTS: list[dict[str, Any]] = [*yaml.safe_load_all((DEPLOY / "job.yaml").read_text())]
JOBS = {each["metadata"]["name"]: each["spec"]["template"] for each in MANIFESTS if each["kind"] == "Job"}


def container(template: dict[str, Any]) -> dict[str, Any]:
    only: dict[str, Any]
    (only,) = template["spec"]["containers"]
    return only


SERVICES: dict[str, list[str]] = {name: each["command"] for name, each in COMPOSE["services"].items()}
ARGUMENTS: dict[str, list[str]] = {name: container(each)["args"] for name, each in JOBS.items()}
COMMANDS = [line[4:] for line in README.splitlines() if line.startswith("    vcmvsp ")]
STEPS = [line for line in COMMANDS if " keys " in line and "launch" not in line]


def parsed(words: list[str]) -> dict[str, Any]:
    """Parameters that the command line parses from these words; unknown options are an error."""
    command = app.command()
    words = words[1:] if words[0] == "vcmvsp" else words
    while hasattr(command, "commands"):
        command, words = command.commands[words[0]], words[1:]
    return command.make_context(command.name, [*words]).params


@pytest.mark.parametrize("words", [*SERVICES.values(), *ARGUMENTS.values(), *map(shlex.split, COMMANDS)], ids=" ".join)
def test_every_command_line_is_valid(words: list[str]) -> None:
    assert parsed([str(each) for each in words])


def test_hosts_files_in_the_readme_are_valid(tmp_path: Path) -> None:
    first, second = re.findall(r"```toml\n(.*?)```", README, re.DOTALL)
    for text, names in ((first, ["laptop", "seven", "car4"]), (second, ["far-example-org"])):
        (tmp_path / "hosts.toml").write_text(text)
        assert [host.called for host in ssh_hosts.read(tmp_path / "hosts.toml").host] == names
    keys = {key for host in tomllib.loads(first)["host"] for key in host} | set(tomllib.loads(second)["host"][0])
    assert keys == {*ssh_hosts.HostTable.__struct_fields__}


def test_unknown_options_are_detected() -> None:
    with pytest.raises(Exception, match="No such option: --conect"):
        parsed(["agent", "--vehicle", "car1", "--conect", "tls/run:7447"])


@pytest.mark.parametrize("commands", [SERVICES, ARGUMENTS], ids=["compose", "kubernetes"])
def test_the_hosts_run_all_agents_and_find_the_run(commands: dict[str, list[str]]) -> None:
    (run,) = (parsed(words) for words in commands.values() if words[0] == "run")
    hosts = [parsed(words) for words in commands.values() if words[0] == "agent"]
    names = [vehicle for host in hosts for vehicle in host["vehicle"]]
    assert sorted(names) == ["car1", "car2", "car3"]
    (endpoint,) = {host["connect"] for host in hosts}
    name, port = re.fullmatch(r"tls/([a-z-]+):(\d+)", endpoint).groups()  # type: ignore[union-attr]
    assert run["listen"] == f"tls/0.0.0.0:{port}"
    assert f"vcmvsp keys init keys --name {name}\n" in README  # a certificate for the name that hosts dial
    assert name in (COMPOSE["services"] if commands is SERVICES else [each["metadata"]["name"] for each in MANIFESTS])


def test_kubernetes_resolves_the_run_and_mounts_secrets_at_their_paths() -> None:
    service = next(each for each in MANIFESTS if each["kind"] == "Service")
    run = JOBS["vcmvsp-run"]
    assert service["spec"]["selector"].items() <= run["metadata"]["labels"].items()
    ports = [each["containerPort"] for each in container(run)["ports"]]
    assert [each["targetPort"] for each in service["spec"]["ports"]] == ports
    for name in ("vcmvsp-one", "vcmvsp-two"):
        assert not service["spec"]["selector"].items() <= JOBS[name]["metadata"]["labels"].items()
    claims = {each["metadata"]["name"] for each in MANIFESTS if each["kind"] == "PersistentVolumeClaim"}
    for name, template in JOBS.items():
        volumes = {each["name"]: each for each in template["spec"]["volumes"]}
        mounted = {each["name"]: each["mountPath"] for each in container(template)["volumeMounts"]}
        assert volumes.keys() == mounted.keys()
        assert volumes["keys"]["secret"] == {"secretName": name, "defaultMode": 0o440}
        assert f"kubectl create secret generic {name} " in README
        assert str(parsed(ARGUMENTS[name])["keys"]).startswith(mounted["keys"])
        claimed = [each["persistentVolumeClaim"] for each in volumes.values() if "persistentVolumeClaim" in each]
        assert {each["claimName"] for each in claimed} <= claims
        assert template["spec"]["restartPolicy"] == "Never"
        assert template["spec"]["securityContext"]["runAsNonRoot"] is True


def test_a_container_sees_no_keys_but_its_own() -> None:
    for name in ("one", "two"):
        assert COMPOSE["services"][name]["volumes"] == [f"./keys/{name}.keys:/keys/{name}.keys:ro"]
        assert f"kubectl create secret generic vcmvsp-{name} --from-file=keys/{name}.keys\n" in README
    secret = next(line for line in README.splitlines() if "generic vcmvsp-run " in line)
    assert "ca.key" not in secret


stage = staged(Stage)


@pytest.mark.parametrize("commands", [SERVICES, ARGUMENTS], ids=["compose", "kubernetes"])
def test_the_command_lines_run_as_local_processes(
    stage: Stage, commands: dict[str, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hosts start first; the folders of containers are folders here, the run's name is localhost."""
    monkeypatch.chdir(stage.folder)
    (dialled,) = set(re.findall(r"tls/([a-z-]+):7447", str(commands)))
    for step in STEPS[: len(STEPS) // 2] if commands is SERVICES else STEPS[len(STEPS) // 2 :]:
        assert vcmvsp_command(*shlex.split(step)[1:]).code == 0

    def here(word: str) -> str:
        word = word.replace(f"tls/{dialled}:7447", f"tls/localhost:{stage.port}")
        word = word.replace("tls/0.0.0.0:7447", f"tls/127.0.0.1:{stage.port}")
        return str(stage.folder / word[1:]) if re.match(r"/(keys|results)", word) else word

    if commands is ARGUMENTS:
        (stage.folder / "keys" / "ca.key").unlink()  # not present in the cluster
    started = {name: stage.start(*map(here, words)) for name, words in reversed(commands.items()) if words[0] == "agent"}
    name, words = next((name, words) for name, words in commands.items() if words[0] == "run")
    started[name] = stage.start(*map(here, words), "--set", "duration_s=2.0")
    outcomes = {name: exit_of(process) for name, process in started.items()}
    assert {code for code, _ in outcomes.values()} == {0}, outcomes
    alone = vcmvsp.run("formation-circle", set={"duration_s": 2.0}, mcap=False)
    assert json.loads((stage.folder / "results" / "circle" / "metrics.json").read_text()) == alone.metrics


def test_the_image_has_the_sources_of_the_wheel() -> None:
    copied = set(re.findall(r"^COPY (?!--)(.*) \S+$", (DEPLOY / "Containerfile").read_text(), re.MULTILINE))
    sources = {name for each in copied for name in each.split()}
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert sources == {"pyproject.toml", "README.md", "LICENSE", "src", *wheel["force-include"]}


def test_the_image_runs_our_program_and_not_as_root() -> None:
    lines = (DEPLOY / "Containerfile").read_text().splitlines()
    assert 'ENTRYPOINT ["vcmvsp"]' in lines
    assert [line for line in lines if line.startswith("USER ")] == ["USER 1000:1000"]
    assert not any("entrypoint" in each for each in COMPOSE["services"].values())
    assert not any("command" in container(each) for each in JOBS.values())
