"""The command status: the state of services and of the replicas that share a broker's events."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Final

import click

from epypes.cli.options import command, json_option, replica_option, source_argument
from epypes.cli.services import DIGITS, connect_to, describe_bundle, describe_failures, is_url, states_of
from epypes.errors import EpypesError
from epypes.wording import counted

if TYPE_CHECKING:
    from epypes.service.state_file import ServiceState

_COUNTS: Final = (
    *("received", "answered", "failed", "dropped", "waiting"),
    *("dead_letters", "redelivered", "duplicates", "given_back"),
)
_NO_GROUP: Final[dict[str, Any]] = {"members": [], "lost": [], "trouble": ""}
# The state of a service that can't be asked, since it has no HTTP control.
_UNKNOWN: Final = "RUNNING"
_NO_HTTP: Final = "no --http"

# A service as JSON: the answer of its HTTP control (`Service.info`, its parameters and its group), or its state file.
Info = dict[str, Any]


@command("epypes status services/edges", "epypes status http://127.0.0.1:8642 --json")
@source_argument
@json_option
@replica_option
def status(source: str, as_json: bool, replica: str) -> None:
    """Show the state of a running service.

    The output has the addresses, the numbers of events and the parameters, and a line for each replica: a service that
    shares the events of the same broker. With --replica it describes one replica.
    """
    if is_url(source):
        services = [_ask(source)]
    else:
        states = states_of(source, replica)
        services = [_ask_or_read(source, state, is_alone=len(states) == 1) for state in states]
    if as_json:
        click.echo(json.dumps(services[0] if len(services) == 1 else services))
        return
    groups: dict[str, list[Info]] = {}
    for service in services:
        queue = _shared_queue(service)
        if queue:
            groups.setdefault(queue, []).append(service)
        if replica or not queue:
            _print_service(service)
    for _, group in sorted(groups.items()):
        _print_group(group, with_members=not replica)


def _ask(url: str) -> Info:
    with connect_to(url, None) as service:
        values = service.parameters().entries
        parameters = {token: entry.get("value") for token, entry in values.items()}
        return {**service.info(), "group": service.group(), "parameters": parameters}


def _ask_or_read(source: str, state: ServiceState, *, is_alone: bool) -> Info:
    """Return a service's answer; its state file, if it has no HTTP control or, beside others, does not answer."""
    silence = {}
    if state.http:
        try:
            return _ask(state.http)
        except EpypesError as error:
            if is_alone:
                raise
            silence = {"state": "SILENT", "reason": str(error)}
    return {
        "bundle": source,
        "digest": state.digest,
        "pid": state.pid,
        "replica": state.replica,
        "addresses": {"sub": state.sub, "pub": state.pub, "failures": state.failures},
        "shows_failures": state.shows_failures,
        **silence,
    }


def _shared_queue(service: Info) -> str:
    """Return the address of the broker's queue that a service shares with its replicas; empty without a broker."""
    from epypes.transport.address import is_broker

    sub: str = service["addresses"]["sub"]
    return sub.partition("?")[0] if is_broker(sub) else ""


# -- one service ------------------------------------------------------------------------------------------------------


def _print_service(service: Info) -> None:
    reason = f" ({service['reason']})" if service.get("reason") else ""
    replica = f", replica {service['replica']}" if service.get("replica") else ""
    no_http = "" if service.get("state") else f", {_NO_HTTP}"
    described = f"{describe_bundle(service)}{replica}, process {service['pid']}{no_http}"
    click.echo(f"{service.get('state', _UNKNOWN)}{reason} {described}.")
    if "counts" in service:
        _print_counts(service["counts"])
    _print_parameters_and_addresses(service)


def _print_counts(counts: dict[str, int]) -> None:
    texts = (f"{counts[name]} {name.replace('_', ' ')}" for name in _COUNTS if name in counts)
    click.echo(f"Events: {', '.join(texts)}.")


def _print_parameters_and_addresses(service: Info) -> None:
    if service.get("parameters"):
        values = ", ".join(f"{token}={json.dumps(value)}" for token, value in service["parameters"].items())
        click.echo(f"Parameters, revision {service['revision']}: {values}")
    if service.get("states"):
        _print_states(service["states"])
    at = service["addresses"]
    failures = describe_failures(at["failures"], service.get("shows_failures", True))
    click.echo(f"Events at {at['sub']}, answers at {at['pub']}{failures}.")


def _print_states(states: dict[str, Any]) -> None:
    tokens = ", ".join(f"{key} of {token}" for key, token in states["tokens"].items())
    forgotten = f", {states['forgotten']} forgotten" if states["forgotten"] else ""
    sources = counted(states["count"], "source") if states["per"] == "source" else "one for all events"
    click.echo(f"State between events: {tokens}; {sources}, {states['bytes']:,} bytes{forgotten}.")


# -- replicas that share the events of a broker -----------------------------------------------------------------------


def _print_group(services: list[Info], *, with_members: bool) -> None:
    """Print what the replicas of one queue have in common, then a line for each, on whichever machine it runs."""
    # A replica that is cut off from the broker hears no other: the one that hears most describes the group.
    asked = [service for service in services if "group" in service]
    first = max(
        asked, key=lambda each: (not each["group"]["trouble"], len(each["group"]["members"])), default=services[0]
    )
    group = first.get("group", _NO_GROUP)
    if asked:
        click.echo(_describe_group(first, group))
    if not with_members:
        return
    if not asked:
        click.echo(f"{describe_bundle(first)}.")
    elif not group["trouble"]:
        _print_counts(group["counts"])
    _print_parameters_and_addresses(first)
    members, lost = _merge_members(services, group)
    bundles = {(member.get("name", ""), member["digest"]) for member in group["members"]}
    for member in members + lost:
        click.echo(_describe_member(member, group["trouble"], with_bundle=len(bundles) > 1))


def _describe_group(service: Info, group: dict[str, Any]) -> str:
    if group["trouble"]:
        return f"Group of {describe_bundle(service)}: the other replicas are not heard: {group['trouble']}"
    agree = "all with" if group["agree"] else "not all with"
    lost = f", lost {len(group['lost'])}" if group["lost"] else ""
    counts = f"replicas {group['replicas']}, ready {group['ready']}{lost}"
    return f"Group: {counts}, {agree} the same bundle and parameters: {describe_bundle(service)}."


def _merge_members(services: Iterable[Info], group: dict[str, Any]) -> tuple[list[Info], list[Info]]:
    """Return the members of a group and the lost ones; with the services of this machine that are no members."""
    host = socket.gethostname()
    here = {(service["replica"], service["pid"]): service for service in services}

    def merged(member: Info) -> Info:
        own = here.pop((member["replica"], member["pid"]), {}) if member["host"] == host else {}
        return {**member, "silence": own["reason"]} if own.get("state") == "SILENT" else member

    members, lost = [merged(each) for each in group["members"]], [merged(each) for each in group["lost"]]
    for service in here.values():
        itself = [each for each in service.get("group", _NO_GROUP)["members"] if each["is_self"]]
        about = {"state": _UNKNOWN, "http": service["addresses"].get("http", ""), "host": host, **service}
        members.append({**about, **(itself[0] if itself else {})})
    return members, lost


def _without_addresses(reason: str) -> str:
    return " ".join(part for part in reason.split() if "://" not in part)


def _describe_member(member: Info, trouble: str, *, with_bundle: bool) -> str:
    """Return the line of a replica; reasons that are the group's trouble too, as an absent broker, are not repeated."""
    texts = dict.fromkeys(filter(None, (member.get(name) for name in ("reason", "trouble", "silence"))))
    reasons = " ".join(text for text in texts if _without_addresses(text) != _without_addresses(trouble))
    parts = [f"{member['state']} ({reasons})" if reasons else member["state"]]
    if "counts" in member:
        parts += [f"{member['counts'].get('answered', 0)} answered", f"revision {member['revision']}"]
    if with_bundle:
        parts.append(f"bundle {member.get('name', '')} ({member['digest'][:DIGITS]})".replace("  ", " "))
    parts += [member["host"], f"process {member['pid']}"]
    if member["http"] or member["state"] != "SILENT":
        parts.append(member["http"] or _NO_HTTP)
    return f"- {member['replica'] or 'one'}: {', '.join(parts)}"
