"""Keys of the network and their speakers; endpoints of a run and the certificates that they require."""

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from tests.support import requirements
from tests.support.cosim.secure_hub import Hub, bundle, dial, issue_certificates, until
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.security.certificates import Keys
from vcmvsp.cosim.transport import access_control, key_names, zenoh_session
from vcmvsp.cosim.transport.endpoints import endpoint_rules

pytestmark = pytest.mark.sockets

names = st.from_regex(r"\A[A-Za-z0-9_-]{1,20}\Z")
zids = st.from_regex(r"\A[0-9a-f]{1,32}\Z")


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Keys:
    return issue_certificates(tmp_path_factory.mktemp("network"))


@given(names, zids)
def test_the_speaker_of_a_key_is_the_name_in_it(name: str, zid: str) -> None:
    assert key_names.speaker(key_names.join_key(name)) == (name, "")
    assert key_names.speaker(key_names.about_key(name)) == (name, "")
    assert key_names.speaker(key_names.host_key(name, zid, "ask")) == (name, zid)
    assert key_names.speaker(key_names.host_key(name, zid, "alive")) == (name, zid)


@given(names, zids, st.sampled_from(["/", "*", "**", "$*", "?", "#", "@", " ", "\n", "\u0661", "/.."]), st.integers(0, 40))
def test_special_characters_give_no_key(name: str, zid: str, evil: str, where: int) -> None:
    bad_name, bad_zid = (each[: where % (len(each) + 1)] + evil + each[where % (len(each) + 1) :] for each in (name, zid))
    for key in (
        key_names.join_key(bad_name),
        key_names.about_key(bad_name),
        f"vcmvsp/host/{bad_name}/{zid}/ask",
        f"vcmvsp/host/{name}/{bad_zid}/alive",
    ):
        assert key_names.speaker(key) is None
    with pytest.raises(ValueError, match="no key of a host"):
        key_names.host_key(name, bad_zid, "ask")


@given(st.text(max_size=60))
def test_any_text_is_a_key_or_none(text: str) -> None:
    assert key_names.speaker(text) is None
    assert key_names.speaker(f"vcmvsp/{text}") is None or "/" in text


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.9.1", "[::1]", "localhost"])
def test_on_this_machine_plain_tcp_will_do(keys: Keys, host: str) -> None:
    endpoint_rules(f"tcp/{host}:7447")
    endpoint_rules(f"tls/{host}:7447", keys)
    with pytest.raises(UsageError, match="plain TCP uses no certificates: write tls/"):
        endpoint_rules(f"tcp/{host}:7447", keys)


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.10", "[::]", "[fe80::1]", "lab.example.org", "localhost.evil.org"])
def test_beyond_this_machine_certificates_are_a_must(keys: Keys, host: str) -> None:
    endpoint_rules(f"tls/{host}:7447", keys)
    endpoint_rules(f"tcp/{host}:7447", insecure=True)
    for side, how in (("run", "--keys DIR (make it with: vcmvsp keys init DIR)"), ("host", "vcmvsp keys vehicle NAME")):
        with pytest.raises(UsageError) as raised:
            endpoint_rules(f"tcp/{host}:7447", side=side)  # type: ignore[arg-type]
        assert f"use tls/{host}:7447 --keys" in str(raised.value)
        assert how in str(raised.value)
        assert "or add --insecure" in str(raised.value)
    with pytest.raises(UsageError, match="TLS needs certificates: add --keys FILE"):
        endpoint_rules(f"tls/{host}:7447", insecure=True, side="observer")


def test_zenoh_dials_no_ipv6_address_with_tls(keys: Keys) -> None:
    try:
        hub = Hub(access_control.hub_security(keys), ("tls/[::1]:0",))
    except zenoh.ZError:
        requirements.not_allowed("IPv6")
    with hub:
        until(lambda: zenoh_session.diagnose(hub.endpoint, bundle(keys, "car2")) is None)
        with pytest.raises(zenoh.ZError):  # if this fails, endpoint_rules need not refuse it
            dial(hub.endpoint, bundle(keys, "car2"))
    endpoint_rules(hub.endpoint, keys)
    for side in ("host", "observer"):
        with pytest.raises(UsageError, match="has no TLS for IPv6 addresses: use a host name"):
            endpoint_rules(hub.endpoint, bundle(keys, "car2"), side=side)


@pytest.mark.parametrize(
    "endpoint",
    [
        "nonsense",
        "192.168.1.10:7447",
        "udp/127.0.0.1:7447",
        "tls/127.0.0.1",
        "tls/:7447",
        "tls/127.0.0.1:70000",
        "tls/10.0.0.1:7447#verify_name_on_connect=false",
        "tls/10.0.0.1:7447?rel=0",
        "tls/::1:7447",
        "tls/10.0.0.1:7447\n",
        "tls/a b:7447",
    ],
)
def test_endpoints_are_a_protocol_a_host_and_a_port(keys: Keys, endpoint: str) -> None:
    with pytest.raises(UsageError, match=r"must be tcp/HOST:PORT or tls/HOST:PORT, e\.g\."):
        endpoint_rules(endpoint, keys, insecure=True)
