"""``vcmvsp keys``: certificates for machines that take part in runs."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vcmvsp.cosim.cli.options import AsJson
from vcmvsp.cosim.errors import UsageError

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Bundle, Keys

KeysDir = Annotated[Path, typer.Option("--keys", metavar="DIR", help="Folder made by 'vcmvsp keys init'.")]
Names = Annotated[
    list[str] | None,
    typer.Option("--name", metavar="NAME_OR_IP", help="Name or address by which other machines reach this one."),
]
Out = Annotated[Path | None, typer.Option(metavar="FILE", help="File or folder to write to [DIR/NAME.keys].")]
Force = Annotated[bool, typer.Option("--force", help="Replace an existing one.")]
HERE = Path("keys")

keys_app = typer.Typer(
    name="keys",
    help="Certificates for machines that take part in runs.\n\nStart with: vcmvsp keys init keys",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@keys_app.command("init", short_help="Make an authority, which signs certificates")
def init_command(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A new folder; keep it on this machine.")] = HERE,
    name: Names = None,
    days: Annotated[int, typer.Option(metavar="N", help="Validity of the certificate of this machine's runs, days.")] = 365,
    force: Annotated[bool, typer.Option("--force", help="Replace the authority; its certificates become invalid.")] = False,
) -> None:
    """Make a certificate authority and the certificate of runs on this machine.

    Example: vcmvsp keys init keys --name 192.168.1.10
    """
    from vcmvsp.cosim.security import authority

    _say_hub(authority.init(folder, name or (), days=days, force=force))


@keys_app.command("hub", short_help="Make the certificate of this machine's runs again")
def hub_command(
    name: Names = None,
    keys: KeysDir = HERE,
    days: Annotated[int, typer.Option(metavar="N", help="Validity, days.")] = 365,
) -> None:
    """Renew the certificate of runs on this machine, e.g. to add names or before it expires.

    Example: vcmvsp keys hub --name 10.0.0.7
    """
    from vcmvsp.cosim.security import authority

    _say_hub(authority.renew_hub(keys, name or (), days=days))


@keys_app.command("vehicle", short_help="Make the key file of a machine that hosts agents")
def vehicle_command(
    vehicle: Annotated[list[str], typer.Argument(metavar="NAME...", help="Vehicles whose agents the machine may run.")],
    keys: KeysDir = HERE,
    as_: Annotated[str | None, typer.Option("--as", metavar="HOST", help="Name of the machine [the vehicle's].")] = None,
    days: Annotated[int, typer.Option(metavar="N", help="How long the certificate is valid.")] = 90,
    out: Out = None,
    force: Force = False,
) -> None:
    """Make the key file of a machine that runs the agents of these vehicles.

    Example: vcmvsp keys vehicle car2; vcmvsp keys vehicle car3 car4 --as laptop
    """
    from vcmvsp.cosim.security import authority

    if as_ is None and len(vehicle) > 1:
        raise UsageError("several vehicles need a name for their machine: add --as HOST")
    bundle = authority.issue(keys, as_ or vehicle[0], vehicle, days=days, out=out, force=force)
    _say_bundle(
        bundle, f"there: vcmvsp agent --vehicle {' --vehicle '.join(bundle.vehicles)} --connect", " [MODULE_OR_FILE:Class]"
    )


@keys_app.command("observer", short_help="Make the key file of an observer")
def observer_command(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the observer.")],
    keys: KeysDir = HERE,
    days: Annotated[int, typer.Option(metavar="N", help="How long the certificate is valid.")] = 90,
    out: Out = None,
    force: Force = False,
) -> None:
    """Make the key file of an observer, who may watch runs but not change them.

    Example: vcmvsp keys observer anna
    """
    from vcmvsp.cosim.security import authority

    _say_bundle(authority.issue(keys, name, days=days, out=out, force=force), "there: vcmvsp watch")


@keys_app.command("list", short_help="List certificates, their vehicles and expiry")
def list_command(keys: KeysDir = HERE, json: AsJson = False) -> None:
    """List all certificates with their vehicles and expiry dates.

    Example: vcmvsp keys list
    """
    from vcmvsp.cosim.security import certificates

    held = certificates.load(keys)
    rows = [("hub", "run", ", ".join(held.names), held.until, certificates.state_of(held.until))]
    rows += [(each.name, each.role, ", ".join(each.vehicles), each.until, each.state) for each in held.index.issued]
    if json:
        from vcmvsp.cosim.util.files import to_json

        fields = ("name", "role", "for", "until", "state")
        sys.stdout.write(to_json([dict(zip(fields, (*row[:3], row[3].isoformat(), row[4]), strict=True)) for row in rows]))
        return
    width = max(len(row[0]) for row in rows)
    for name, role, names, until, state in rows:
        sys.stdout.write(f"{name:<{width}}  {role:<8}  until {until:%Y-%m-%d}  {state:<12}  {names}".rstrip() + "\n")


@keys_app.command("revoke", short_help="Revoke the certificate of a machine")
def revoke_command(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name as in 'vcmvsp keys list'.")], keys: KeysDir = HERE
) -> None:
    """Revoke the certificate of a machine. Its name cannot be used again.

    Example: vcmvsp keys revoke laptop
    """
    from vcmvsp.cosim.security import authority

    entry = authority.revoke(keys, name)
    sys.stdout.write(f"{entry.name} is revoked: runs that start from now on reject it\n")


def _say_hub(keys: "Keys") -> None:
    sys.stdout.write(f"{keys.folder}: valid until {keys.until:%Y-%m-%d}; names of this machine: {', '.join(keys.names)}\n")
    sys.stdout.write(f"next, for each machine: vcmvsp keys vehicle NAME --keys {keys.folder}\n")


def _say_bundle(bundle: "Bundle", then: str, last: str = "") -> None:
    sys.stdout.write(f"{bundle.path}: valid until {bundle.until:%Y-%m-%d}; copy it to its machine and keep it secret\n")
    sys.stdout.write(f"{then} tls/HOST:PORT --keys {bundle.path.name}{last}\n")
