"""``epypes status``: what runs, in which state, and what became of its events."""

from __future__ import annotations

import json
import socket
from typing import TYPE_CHECKING, Annotated, Any

import typer

from epypes.cli.source import Source, connected, is_url, states_of
from epypes.cli.terminal import failures_at, out
from epypes.errors import EpypesError

if TYPE_CHECKING:
    from epypes.service.state_file import ServiceState

_COUNTS = ("received", "answered", "failed", "dropped", "waiting")
# What is counted besides where a broker delivers the events.
_OF_BROKER = ("dead_letters", "redelivered", "duplicates", "given_back")
_DIGITS = 12
_UNKNOWN = "RUNNING"
_NO_HTTP = "no --http"
# In what replicas of one group should be alike.
_MAY_DIFFER = ("name", "digest")


def status(
    source: Source,
    as_json: Annotated[bool, typer.Option("--json", help="Print all that is known as JSON.")] = False,
    replica: Annotated[
        str,
        typer.Option(help="Which of several services of the bundle here; without, all of them and their whole group."),
    ] = "",
) -> None:
    """Say in which state a running service is, where it listens, and how many events it has answered."""
    found = [_of_url(source)] if is_url(source) else _of_all(source, states_of(source, replica))
    if as_json:
        out.print(json.dumps(found[0] if len(found) == 1 else found))
        return
    shared = {each["addresses"]["sub"].partition("?")[0] for each in found if _is_shared(each)}
    alone = [each for each in found if replica or not _is_shared(each)]
    for line in (line for each in alone for line in _lines(each)):
        out.print(line)
    for sub in sorted(shared):
        of_sub = [each for each in found if each["addresses"]["sub"].partition("?")[0] == sub]
        for line in _group_lines(of_sub, is_one=bool(replica)):
            out.print(line)


def _is_shared(found: dict[str, Any]) -> bool:
    """Whether a service takes its events from a broker, as others may."""
    from epypes.transport.address import is_broker

    return is_broker(found["addresses"]["sub"])


def _of_all(source: str, states: list[ServiceState]) -> list[dict[str, Any]]:
    """Return what there is to know of each; one that says nothing keeps nobody from hearing of the others."""
    if len(states) == 1:
        return [_of(source, states[0])]
    found = []
    for state in states:
        try:
            found.append(_of(source, state))
        except EpypesError as error:
            found.append({**_written(source, state), "state": "SILENT", "reason": str(error)})
    return found


def _of(source: str, state: ServiceState) -> dict[str, Any]:
    return _of_url(state.http) if state.http else _written(source, state)


def _written(source: str, state: ServiceState) -> dict[str, Any]:
    """Return what a service has left in its state file."""
    addresses = {"sub": state.sub, "pub": state.pub, "failures": state.failures}
    served = {"bundle": source, "digest": state.digest, "pid": state.pid, "replica": state.replica}
    return {**served, "addresses": addresses, "shows_failures": state.shows_failures}


def _of_url(url: str) -> dict[str, Any]:
    with connected(url, None) as service:
        found = service.info()
        values = service.parameters().entries
        group = service.group()
    return {**found, "group": group, "parameters": {token: entry.get("value") for token, entry in values.items()}}


def _lines(found: dict[str, Any]) -> list[str]:
    reason = f" ({found['reason']})" if found.get("reason") else ""
    named = f", replica {found['replica']}" if found.get("replica") else ""
    more = "" if found.get("state") else f", {_NO_HTTP}"
    served = f"{found['bundle']} ({found['digest'][:_DIGITS]}){named}, process {found['pid']}{more}"
    lines = [f"{found.get('state', _UNKNOWN)}{reason} {served}."]
    if "counts" in found:
        lines.append(_events_line(found["counts"]))
    return [*lines, *_parameters_line(found), _addresses_line(found)]


def _events_line(counts: dict[str, int]) -> str:
    names = (*_COUNTS, *_OF_BROKER) if "redelivered" in counts else _COUNTS
    told = (f"{counts[name]} {name.replace('_', ' ')}" for name in names if name in counts)
    return f"Events: {', '.join(told)}."


def _parameters_line(found: dict[str, Any]) -> list[str]:
    if not found.get("parameters"):
        return []
    values = ", ".join(f"{token}={json.dumps(value)}" for token, value in found["parameters"].items())
    return [f"Parameters, revision {found['revision']}: {values}"]


def _addresses_line(found: dict[str, Any]) -> str:
    at = found["addresses"]
    more = failures_at(at["failures"], found.get("shows_failures", True))
    return f"Events at {at['sub']}, answers at {at['pub']}{more}."


# -- replicas that share the events of a broker -----------------------------------------------------------------------


def _group_lines(found: list[dict[str, Any]], *, is_one: bool) -> list[str]:
    """Return what all replicas are like that take events from one place, wherever they run: a line for each.

    Parameters
    ----------
    found
        Those that were asked, or have left word here.
    is_one
        Whether one was asked for by name, and is told of already.
    """
    # Whom the broker is away for hears nobody: who hears most is asked.
    asked = sorted((each for each in found if "group" in each), key=_hears, reverse=True)
    first = asked[0] if asked else found[0]
    group = first.get("group", {"members": [], "lost": [], "trouble": ""})
    lines = _head_lines(first, group) if asked else []
    if is_one:
        return lines
    if not asked:
        lines = [f"{first['bundle']} ({first['digest'][:_DIGITS]})."]
    elif not group["trouble"]:
        lines.append(_events_line(group["counts"]))
    lines += [*_parameters_line(first), _addresses_line(first)]
    differ = {name: len({each[name] for each in group["members"] if name in each}) > 1 for name in _MAY_DIFFER}
    told = {_gist(group["trouble"])}
    members, lost = _members(found, group)
    lines += [_member_line(member, differ, told) for member in members]
    # Each of them is lost for himself, though all may have been heard last at the same time.
    return [*lines, *(_member_line(member, differ, set()) for member in lost)]


def _hears(found: dict[str, Any]) -> tuple[bool, int]:
    return not found["group"]["trouble"], len(found["group"]["members"])


def _head_lines(found: dict[str, Any], group: dict[str, Any]) -> list[str]:
    served = f"{found['bundle']} ({found['digest'][:_DIGITS]})"
    if group["trouble"]:
        return [f"Group of {served}: the other replicas are not heard: {group['trouble']}"]
    agree = "all with" if group["agree"] else "not all with"
    lost = f", lost {len(group['lost'])}" if group["lost"] else ""
    said = f"Group: replicas {group['replicas']}, ready {group['ready']}{lost}, {agree} the same bundle and parameters"
    return [f"{said}: {served}."]


def _members(found: list[dict[str, Any]], group: dict[str, Any]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return who is in a group or runs here besides, and who is lost; with what was seen of them here."""
    here = {(each["replica"], each["pid"]): each for each in found}

    def seen(member: dict[str, Any]) -> dict[str, Any]:
        own = here.pop((member["replica"], member["pid"]), {}) if _is_here(member) else {}
        return {**member, "silent": own.get("reason", "") if own.get("state") == "SILENT" else ""}

    members, lost = [seen(each) for each in group["members"]], [seen(each) for each in group["lost"]]
    return [*members, *(_member_of(each) for each in here.values())], lost


def _is_here(member: dict[str, Any]) -> bool:
    return bool(member["host"] == socket.gethostname())


def _member_of(found: dict[str, Any]) -> dict[str, Any]:
    """Return what is known of a replica that is no member of the group that was asked."""
    own = [each for each in found.get("group", {}).get("members", ()) if each["is_self"]]
    served = {"http": found["addresses"].get("http", ""), "host": socket.gethostname(), **found}
    return {"state": _UNKNOWN, "reason": "", "trouble": "", **served, **(own[0] if own else {})}


def _member_line(member: dict[str, Any], differ: dict[str, bool], told: set[str]) -> str:
    """Return what there is to say of a member, but for reasons that were told before: one broker is away for all."""
    reasons = []
    for text in filter(None, (member.get(name, "") for name in ("reason", "trouble", "silent"))):
        if _gist(text) not in told:
            reasons.append(text)
            told.add(_gist(text))
    why = f" ({' '.join(reasons)})" if reasons else ""
    parts = [f"{member['state']}{why}"]
    if "counts" in member:
        parts += [f"{member['counts'].get('answered', 0)} answered", f"revision {member['revision']}"]
    parts += _differences(member, differ)
    at = member["http"] or (_NO_HTTP if member["state"] != "SILENT" else "")
    parts += [member["host"], f"process {member['pid']}", *filter(None, [at])]
    return f"- {member['replica'] or 'one'}: {', '.join(parts)}"


def _gist(reason: str) -> str:
    """Return a reason without places, of which a broker has several."""
    return " ".join(word for word in reason.split() if "://" not in word)


def _differences(member: dict[str, Any], differ: dict[str, bool]) -> list[str]:
    """Return which bundle a member serves, if not all serve the same one."""
    if not any(differ.values()):
        return []
    return [f"bundle {member.get('name', '')} ({member['digest'][:_DIGITS]})".replace("  ", " ")]
