"""Commands and blocks of the READMEs that another test runs, or that cannot be run here, and why."""

import re

from tests.support.docs.readme_pages import COMMANDS
from vcmvsp.cosim.scenario import loader

GALLERY = "tests/docs/test_gallery.py::test_a_built_in_scenario_prints_its_gallery_text"
SEARCHES = "tests/agents/reconnaissance/test_gallery.py::test_a_reconnaissance_scenario_prints_its_gallery_text"
CORNERS = "tests/validation/test_built_in_studies.py::test_every_corner_of_a_study_is_a_valid_scenario"
PAGES = "tests/docs/test_pages.py"
OWN_METRICS = f"{PAGES}::test_own_metrics_agree_with_the_page"
WORLDS = "tests/docs/test_readme.py::test_commands_for_worlds_and_vehicles_work"
MACHINES = "tests/docs/test_machines.py::test_a_run_a_host_and_an_observer_with_certificates"
STARTED = "tests/docs/test_machines.py::test_hosts_started_with_the_run"
WATCHED = "tests/docs/test_machines.py::test_a_watched_run"
DEPLOYED = "tests/cosim/hosts/test_containers.py::test_the_command_lines_run_as_local_processes"
SECRETS = "tests/cosim/hosts/test_containers.py::test_a_container_sees_no_keys_but_its_own"
HOSTS = "tests/cosim/hosts/test_containers.py::test_hosts_files_in_the_readme_are_valid"
NETWORK = "tests/cosim/cli/test_net.py::test_ping_agrees_with_the_recorded_radio"
LEFT_OVER = "tests/cosim/cli/test_net.py::test_status_shows_addresses_and_a_live_run"
ROUTED = "tests/netsim/bridge/test_routing_program.py::test_routes_over_five_hops_carry_datagrams_and_are_repaired"
RADIOS = "tests/netsim/bridge/test_several_radios.py::test_datagrams_are_lost_as_recorded_on_their_radio"
PORTS = "tests/netsim/bridge/test_readme.py::test_the_worked_example"
TEN_LINES = "tests/netsim/bridge/test_readme.py::test_the_ten_lines_of_the_radios_page"
OWN_DOOR = "tests/netsim/bridge/test_readme.py::test_the_custom_gateway_of_the_page_works"
DIALOGUE = "tests/docs/test_doors.py::test_programs_at_the_gateways"
TURNS = "tests/netsim/sockets/test_readme.py::test_the_worked_example"
OBSERVER = "tests/cosim/hosts/test_watch.py::test_the_readme_watches_a_run"
OBSERVED_PAGE = "tests/cosim/hosts/test_watch.py::test_a_page_elsewhere_shows_the_run_without_controls_and_changes_no_bit"


def _in_the_gallery() -> dict[str, str]:
    """Runs and studies of the built-in scenarios, which the gallery's tests cover."""
    found: dict[str, str] = {}
    for each in COMMANDS:
        match = re.fullmatch(r"vcmvsp (run|study) (\S+)( --(set|out) \S+)*", each.text)
        if match and each.page == "scenarios/README.md" and (name := match[2]) in loader.names():
            run = SEARCHES if name.startswith("recon-") else GALLERY
            found[each.text] = CORNERS if match[1] == "study" else run
    return found


LEARNING = "tests/docs/test_learning.py::test_blocks_of_the_page_run"
LEARNED = "tests/docs/test_examples.py::test_learning_writes_policies_that_fly_and_the_figure"
LEARNING_TASK = "tests/cosim/cli/test_new.py::test_all_parts_run_and_pass_their_own_tests_unedited"
EXAMPLES = "tests/docs/test_examples.py::test_a_script_makes_its_picture"

RELAYS = "tests/validation/test_relay_canyon.py::test_rays_reach_around_corners_and_walls_do_not"

ELSEWHERE = _in_the_gallery() | {
    "vcmvsp study relay-canyon --vary vehicle.relay.count=1,2,3,4 --seeds 1 --metric routing.delivery_ratio": RELAYS,
    ".venv/bin/python examples/loss_and_delay.py": EXAMPLES,
    ".venv/bin/python examples/study_bands.py pictures 3": EXAMPLES,
    ".venv/bin/python examples/own_agent.py pictures": EXAMPLES,
    "vcmvsp new task meet": LEARNING_TASK,
    "make demo": "tests/docs/test_readme.py::test_the_demo_prints_the_output_in_the_readme",
    "vcmvsp export runs/demo/hold --mp4": (
        "tests/cosim/export/test_export.py::test_below_the_film_is_the_formation_error_so_far"
    ),
    "vcmvsp view runs/demo/hold": (
        "tests/cosim/cli/test_view.py::test_it_prints_a_url_serves_the_page_only_there_and_ends_quietly"
    ),
    "vcmvsp view runs/formation-circle-1": (
        "tests/cosim/cli/test_view.py::test_it_prints_a_url_serves_the_page_only_there_and_ends_quietly"
    ),
    "vcmvsp figure 24": "tests/cosim/reproduction/test_figures.py::test_figure",
    "vcmvsp figure estimators": "tests/cosim/reproduction/test_slow_figures.py::test_estimators",
    "vcmvsp figure loss --json": "tests/cosim/reproduction/test_slow_figures.py::test_loss",
    "vcmvsp run gap.toml --out gap": "tests/docs/test_readme.py::test_the_twenty_lines_keep_the_gap",
    "vcmvsp --install-completion": "tests/cosim/cli/test_completion.py::test_bash_itself_completes",
    "vcmvsp stop": "tests/cosim/cli/test_stop.py::test_all_are_stopped_and_stay_so",  # here it would stop other tests' robots
    "vcmvsp list worlds": WORLDS,
    "vcmvsp show vehicle quadrotor": WORLDS,
    "vcmvsp world urban --set seed=3 --png city.png": WORLDS,
    'vcmvsp drive swarm-100 --vehicle uav1 --command "vx=2" --seconds 4': WORLDS,
    "vcmvsp keys init keys --name 192.168.1.10": MACHINES,
    "vcmvsp keys vehicle car2 --keys keys": MACHINES,
    "vcmvsp keys observer anna --keys keys --out anna.keys": MACHINES,
    "vcmvsp run gap.toml --set vehicle.car2.agent.runs=zenoh --listen tls/0.0.0.0:7447 --keys keys": MACHINES,
    "vcmvsp agent keep_gap.py:KeepGap --vehicle car2 --connect tls/192.168.1.10:7447 --keys car2.keys": MACHINES,
    "vcmvsp watch tls/192.168.1.10:7447 --keys anna.keys --topic 'car2/*'": MACHINES,
    "vcmvsp watch tls/192.168.1.10:7447 --keys anna.keys --view": OBSERVED_PAGE,
    "vcmvsp doctor --connect tls/192.168.1.10:7447 --keys anna.keys": MACHINES,
    "vcmvsp run formation-circle --realtime --listen tls/0.0.0.0:7447 --keys keys": WATCHED,
    "vcmvsp run formation-circle --set bridge.udp.first_port=18000": (
        "tests/docs/test_doors.py::test_ports_agree_with_the_page"
    ),
    "vcmvsp run swarm.toml": "tests/hardware/stacks/test_crazyflie.py::test_programs_of_cflib_fly_a_swarm_and_trajectories",
    "vcmvsp run nodes.toml": "tests/hardware/stacks/test_ros2.py::test_in_real_time_a_node_drives_and_its_end_is_a_loss",
    "vcmvsp run copters.toml": "tests/hardware/firmware/test_flights.py::test_several_take_off_fly_to_way_points_and_land",
    "vcmvsp launch gap.toml --hosts hosts.toml --keys keys": STARTED,
    "vcmvsp launch my_scenario.toml --hosts hosts.toml --keys keys": STARTED,
    "vcmvsp keys init keys --name run": DEPLOYED,
    "vcmvsp keys init keys --name vcmvsp-run": DEPLOYED,
    "vcmvsp keys vehicle car1 car2 --as one --keys keys": DEPLOYED,
    "vcmvsp keys vehicle car3 --as two --keys keys": DEPLOYED,
    "kubectl create secret generic vcmvsp-one --from-file=keys/one.keys": SECRETS,
    "kubectl create secret generic vcmvsp-two --from-file=keys/two.keys": SECRETS,
    "sudo .venv/bin/vcmvsp net up formation-circle": NETWORK,
    "sudo .venv/bin/vcmvsp net exec car2 -- ping car1": NETWORK,
    "sudo vcmvsp net up formation-circle --duration 600 --set radio.delay.seconds=0.02": NETWORK,
    "sudo vcmvsp net exec car2 -- ping car1": NETWORK,
    "sudo vcmvsp net status": LEFT_OVER,
    "for car in car1 car2 car3 car4 car5 car6 relief; do": ROUTED,
    'ip netns exec vcmvsp-chain-$car babeld -w -h 1 -I "" -S "" radio0': ROUTED,
    'trap "kill 0" INT': ROUTED,
    "number=0": ROUTED,
    "number=$((number + 1))": ROUTED,
    'sed "s/NUMBER/$number/" bird.conf > $car.conf': ROUTED,
    "ip netns exec vcmvsp-chain-$car sysctl -q net.ipv4.ip_forward=1": ROUTED,
    "ip netns exec vcmvsp-chain-$car bird -f -c $car.conf -s $car.ctl": ROUTED,
    "done": ROUTED,
    "wait": ROUTED,
    "sudo vcmvsp net up chain.toml": ROUTED,
    "sudo vcmvsp net exec car1 -- ping car2.lora": RADIOS,
    "sudo vcmvsp net exec car1 -- ping car2": RADIOS,
    "sudo vcmvsp net exec car1 -- ip route add 10.77.0.2/32 via 10.78.0.2": RADIOS,
    "sudo sh babel.sh": ROUTED,
    "sudo vcmvsp net exec car1 -- ip route": ROUTED,
    "sudo vcmvsp net exec car1 -- ping -4 -c 20 -i 0.2 car6": ROUTED,
    "sudo vcmvsp net exec car6 -- iperf3 -s -1 -D": ROUTED,
    "sudo vcmvsp net exec car1 -- iperf3 -4 -c car6 -u -l 200 -b 160k": ROUTED,
    "vcmvsp run two-programs.toml --out two-programs": PORTS,
    "python echo.py": PORTS,
    "python ask.py": PORTS,
    "vcmvsp run sockets.toml --out runs/sockets": TURNS,
    "python pong.py": TURNS,
    "python ping.py": TURNS,
}
"""The test that runs a command or, where that needs root, another machine or minutes, does the same on a smaller scale."""

NO_CONTAINERS = "there are no containers on machines that run these tests"
UNRUN = {
    "pip install 'vcmvsp[foxglove]'": "it fetches a library",
    "make test": "it runs the tests themselves",
    "make site": "it installs what builds the site; `tests/docs/test_site.py` builds it where that is there",
    "pip install 'vcmvsp[learn]'": "it installs from an index; the environment of the tests has what it installs",
    "make dist": "it fetches what builds and checks archives",
    "docker run --rm vcmvsp": NO_CONTAINERS,
    "docker build -t vcmvsp -f cosim/deploy/Containerfile .": NO_CONTAINERS,
    "mkdir -p results": "no program of ours; the command after it needs containers",
    "VCMVSP_USER=$(id -u):$(id -g) docker compose up --abort-on-container-failure": NO_CONTAINERS,
    "kubectl create secret generic vcmvsp-run --from-file=keys/ca.pem --from-file=keys/hub.pem --from-file=keys/hub.key"
    " --from-file=keys/index.json": NO_CONTAINERS,
    "kubectl apply -f job.yaml": NO_CONTAINERS,
    "kubectl wait --for=condition=complete --timeout=600s job/vcmvsp-run": NO_CONTAINERS,
    "kubectl logs job/vcmvsp-run": NO_CONTAINERS,
    "unshare --user --map-root-user --mount --net sh -c 'mount -t tmpfs tmpfs /run; ip link set lo up; exec bash'": (
        "few kernels let tests make user namespaces"
    ),
}
"""Why a command cannot be run here, nor anything like it."""

SHOWN = {
    ("docs/howto/ros2.md", "ros2 service call"): (
        "tests/hardware/stacks/test_simulation_services.py"
        "::test_calls_pause_step_and_change_a_run_which_is_recorded_and_repeatable"
    ),
    ("netsim/bridge/README.md", "protocol babel"): ROUTED,
    ("docs/explanation/rays.md", "load_scene("): ("tests/physics/raycast/test_mitsuba_scene.py::test_sionna_finds_equal_paths"),
    ("README.md", "dead-reckoning  52 %"): "tests/docs/test_readme.py::test_the_demo_prints_the_output_in_the_readme",
    ("README.md", "class KeepGap"): "tests/docs/test_readme.py::test_the_twenty_lines_keep_the_gap",
    ("docs/howto/programs.md", "where are you?"): TEN_LINES,
    ("docs/tutorial.md", "formation-circle: 3 agents"): f"{PAGES}::test_the_tutorial_shows_the_output_of_its_first_run",
    ("docs/tutorial.md", "class MyFollower"): f"{PAGES}::test_the_agent_of_the_tutorial_has_the_errors_on_the_page",
    ("docs/tutorial.md", "check_agent(lambda"): f"{PAGES}::test_the_agent_of_the_tutorial_passes_its_check",
    ("docs/howto/learning.md", 'parallel_env("formation", seed=1'): LEARNING,
    ("docs/howto/learning.md", "gymnasium.make("): LEARNING,
    ("docs/howto/learning.md", 'vector_env("formation"'): LEARNING,
    ("docs/howto/learning.md", "vcmvsp.start("): LEARNING,
    ("docs/howto/learning.md", 'file = "lossy-1.npz"'): LEARNED,
    ("docs/howto/own-metric.md", "self.note(disagreement_m"): OWN_METRICS,
    ("docs/howto/own-metric.md", "worst_m ="): OWN_METRICS,
    ("docs/howto/own-metric.md", "def above("): OWN_METRICS,
    ("docs/howto/own-metric.md", "late_share ="): OWN_METRICS,
    ("docs/howto/own-metric.md", "result.notes.to_pandas()"): OWN_METRICS,
    ("docs/howto/export.md", "parquet.read_table"): f"{PAGES}::test_tables_are_read_as_on_the_page",
    ("docs/reference/author-api.md", "class Column"): f"{PAGES}::test_the_agent_of_the_authors_page_works",
    ("docs/explanation/design.md", "scenario.toml -> federates"): "a drawing",
    ("docs/explanation/rays.md", "x,y,z"): "tests/docs/test_commands.py::test_commands_run_and_write_their_files",
    ("docs/explanation/rays.md", "gain_dbi"): "tests/netsim/propagation/test_antennas.py::test_the_pattern_of_the_page",
    ("docs/explanation/rays.md", "E(s) = D E(edge)"): "equations",
    ("README.md", "r = vcmvsp.run("): "tests/docs/test_readme.py::test_the_lines_for_python_run",
    (
        "docs/reference/agents.md",
        "class Waltz",
    ): "tests/agents/formation/leaders/test_trajectory.py::test_the_leader_of_the_readme_works",
    ("docs/reference/agents.md", "class Advance"): "tests/agents/test_readme.py::test_it_flies_east_until_an_obstacle_is_near",
    ("docs/reference/agents.md", "class Nearest"): "tests/agents/test_readme.py::test_it_stops_at_a_strong_signal",
    (
        "docs/reference/agents.md",
        "class Cautious",
    ): "tests/agents/formation/reports/test_prediction.py::test_the_estimator_of_the_readme_works",
    (
        "docs/reference/agents.md",
        "class Stop",
    ): "tests/agents/test_readme.py::test_the_example_avoidance_stops_before_obstacles",
    ("cosim/README.md", "check_federate("): "tests/docs/test_blocks.py::test_the_custom_federate",
    ("docs/howto/cluster.md", "SLURMCluster("): "tests/docs/test_blocks.py::test_the_call_of_a_study_on_slurm_is_valid",
    ("cosim/deploy/README.md", "robot7"): HOSTS,
    ("cosim/deploy/README.md", "ExitOnForwardFailure"): HOSTS,
    ("cosim/hosts/README.md", "verify_name_on_connect"): OBSERVER,
    ("cosim/hosts/README.md", "import zenoh"): OBSERVER,
    ("cosim/hosts/README.md", "#include <zenoh.h>"): "not compiled: no package that tests could install has zenoh-c",
    ("hardware/README.md", "ArcosDriver("): "tests/hardware/test_readme.py::test_the_example_drives_a_robot",
    ("docs/howto/radio-layer.md", "class Rain"): "tests/netsim/test_readme.py::test_the_layers_of_ones_own",
    ("netsim/bridge/README.md", "hears.recvfrom"): PORTS,
    ("netsim/bridge/README.md", "asks.sendto"): PORTS,
    ("netsim/bridge/README.md", "GETSS {Robot car2}"): DIALOGUE,
    ("netsim/bridge/README.md", "declare_subscriber"): DIALOGUE,
    ("netsim/bridge/README.md", "class RollCall"): OWN_DOOR,
    ("netsim/sockets/README.md", "socket.time()"): TURNS,
    ("netsim/sockets/README.md", 'b"pong"'): TURNS,
    ("netsim/sockets/README.md", "44 of 100"): TURNS,
    ("physics/README.md", "federate.py "): "tests/physics/test_readme.py::test_every_named_file_and_kind_exists",
    ("docs/howto/own-vehicle.md", "<robot name="): "tests/physics/test_readme.py::test_the_custom_vehicle",
    ("docs/howto/own-sensor.md", "class Sonar"): "tests/physics/test_readme.py::test_the_custom_sensor",
    ("docs/howto/own-world.md", "class Orchard"): "tests/physics/test_readme.py::test_the_custom_world",
    ("scenarios/README.md", "radio:     "): GALLERY,
    ("docs/reference/agents.md", "v . u_i <= approach"): "an equation",
    ("docs/reference/agents.md", "F(x) = (R - x)/(x - r)"): "equations",
    ("docs/reference/agents.md", "width = sqrt(a^2"): "equations",
    ("docs/explanation/formations.md", "u_i = kappa sum_j"): "an equation",
    ("docs/explanation/formations.md", "th_f) (p_l + Rot(th_l) c"): "equations",
    ("netsim/README.md", "queue of the sender -> access"): "a drawing",
    ("netsim/bridge/README.md", "program -> gateway -> store"): "a drawing",
    ("netsim/sockets/README.md", "program --sendto--> turn"): "a drawing",
}
"""By page, and words in a block that is neither a scenario nor for a shell: the test that uses it, or what it is."""
