"""Commands that run and control a service: serve, stop, set, deploy, rollback; and how they find it."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import resource
import select
import signal
import stat
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from threading import TIMEOUT_MAX
from time import monotonic
from typing import TYPE_CHECKING, Any, Final, TextIO, cast

import click

from epypes.cli.options import (
    PATH,
    access_key_option,
    allow_option,
    bundle_argument,
    command,
    insecure_option,
    keys_option,
    replica_option,
    seconds_option,
    source_argument,
)
from epypes.errors import KeysError, ServiceError
from epypes.wording import without_access_key

if TYPE_CHECKING:
    from epypes.service.event_states import StateChoice
    from epypes.service.remote.connection import Connection
    from epypes.service.state_file import ServiceState

_ANY_PORT: Final = "tcp://127.0.0.1:*"
DIGITS: Final = 12

_service_option: Final = click.option(
    "--http",
    "--service",
    "source",
    required=True,
    help="URL of the service, as http://127.0.0.1:8642, or the bundle that it was started with.",
)


_state_option: Final = click.option(
    "--state",
    type=click.Choice(["keep", "reset"]),
    show_default="keep if both bundles delay the same tokens",
    help="What becomes of the state between events.",
)

# -- which service a command is about ---------------------------------------------------------------------------------


def is_url(source: str) -> bool:
    """Whether a source is the URL of a service, not a path."""
    return source.startswith(("http://", "https://"))


def states_of(source: str, replica: str = "") -> list[ServiceState]:
    """Return the states of this user's running services of a bundle or URL: one, or one per replica.

    Raises
    ------
    ServiceError
        No service runs for this bundle, or at this address.
    """
    from epypes.service.remote.control import split_url
    from epypes.service.state_file import read_states, running_at

    if is_url(source):
        found = [state for state in [running_at(split_url(source)[0])] if state is not None]
        way_out = "Is it another user's, or another machine's?"
    else:
        if not Path(source).is_dir():
            raise ServiceError(source, f"{source} does not exist. Name the bundle that is served, or its http URL.")
        found, way_out = read_states(Path(source), replica), f"Start it: epypes serve {source}"
    if not found:
        named = f" as replica {replica!r}" if replica else ""
        raise ServiceError(source, f"No service of yours runs for {source}{named}. {way_out}")
    return found


def connect_to(source: str, access_key_file: Path | None, replica: str = "") -> Connection:
    """Connect to the HTTP control of a service; of several replicas to the first that has one.

    Raises
    ------
    ServiceError
        No service runs, or it has no HTTP address.
    KeysError
        The access key can't be read.
    """
    from epypes.service.remote.connection import connect

    url = source if is_url(source) else next((state.http for state in states_of(source, replica) if state.http), "")
    if not url:
        raise ServiceError(source, f"The service of {source} has no HTTP address. Start it with --http 127.0.0.1:8642.")
    try:
        key = None if access_key_file is None else access_key_file.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        text = f"The file {access_key_file} of the access key can't be read: {error}."
        raise KeysError(access_key_file, text) from error
    return connect(url, access_key=key)


def describe_bundle(service: Mapping[str, Any]) -> str:
    """Return the bundle of a service, which is given as its info, with the beginning of its digest."""
    return f"{service['bundle']} ({service['digest'][:DIGITS]})"


def describe_failures(address: str, is_shown: bool) -> str:
    """Return the address of failures, to be printed after other addresses; empty where no option names one."""
    return f", failures at {address}" if is_shown else ""


# -- the commands -----------------------------------------------------------------------------------------------------


@command(
    "epypes serve services/edges --http 127.0.0.1:8642",
    "epypes serve services/edges --sub tcp://127.0.0.1:5555 --pub tcp://127.0.0.1:5556 --threads 2",
    "epypes serve services/edges --sub 'amqp://127.0.0.1/frames?create=true' --pub amqp://127.0.0.1/edges",
)
@bundle_argument
@click.option("--sub", default=_ANY_PORT, help="Address of events: one to bind, connect:ADDRESS, or a broker's queue.")
@click.option("--pub", default=_ANY_PORT, help="Address of answers: one to bind, connect:ADDRESS, or a broker's queue.")
@click.option("--failures", default=_ANY_PORT, help="Extra address that receives only failures, as --pub.")
@click.option("--http", default="", help="Address of the HTTP control, as 127.0.0.1:8642.", show_default="none")
@click.option(
    "--threads",
    type=click.IntRange(1, 64),
    default=1,
    help="Number of events computed at once; answers in order, with --state-per source those of one source.",
)
@seconds_option("--job-timeout", 30.0, "Longest time for one event, until the worker is replaced", least=0.01)
@seconds_option("--drain-timeout", 5.0, "Longest wait for accepted events after SIGTERM")
@click.option("--retries", type=click.IntRange(0), default=1, help="Retries of an event that kills the worker.")
@click.option("--mailbox", default="drop_oldest", help="When too many events wait: drop_oldest, latest or fault.")
@click.option("--mailbox-size", type=click.IntRange(1), default=8, help="Number of events that may wait; 1 for latest.")
@insecure_option
@keys_option
@allow_option
@click.option("--access-key-file", type=PATH, help="File of the HTTP control's access key; default: a new one.")
@click.option("--store", help="SQLite file (extra store) or database URL (extra postgres), for a row per event.")
@click.option("--replica", default="", show_default="a number", help="Name among the replicas that share a queue.")
@click.option(
    "--state-per",
    type=click.Choice(["one", "source"]),
    default="one",
    help="State between events: one for all, or one for each source of events.",
)
@click.option("--partitioned", is_flag=True, help="The broker delivers all events of one source to one replica.")
def serve(bundle: Path, sub: str, pub: str, mailbox: str, mailbox_size: int, **options: Any) -> None:
    """Serve a bundle until SIGTERM or Ctrl+C.

    Events come from a SUB socket or a broker's queue, answers go to a PUB socket or a broker's queue. Failures also
    arrive as answers.

    A broker's address is amqp://, nats:// or mqtt://[USER@]HOST/NAME.

    Its password is read from a file, ?password_file=PATH, since process lists show addresses.

    More options follow with & (quote the address): create=true, attempts=3, dead=NAME, group=NAME, kind=broadcast,
    vhost=NAME, ca=FILE.
    """
    from epypes.service import serve as serve_bundle
    from epypes.service.supervision.standard_error import STANDARD_ERROR

    # No thread of the service waits for a reader of standard error.
    handler = logging.StreamHandler(cast("TextIO", STANDARD_ERROR))
    logging.basicConfig(
        level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s", handlers=[handler]
    )
    # Connections take descriptors; the soft limit is often 1,024, for programs that call select().
    with contextlib.suppress(OSError, ValueError):
        hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))

    def on_fault(reason: str) -> None:
        STANDARD_ERROR.write(f"FAULTED {bundle}: {reason}\n")

    counts = serve_bundle(
        bundle,
        sub,
        pub,
        mailbox_policy=mailbox,
        mailbox_size=1 if mailbox == "latest" else mailbox_size,
        on_ready=lambda state: _print_ready(bundle, state),
        on_fault=on_fault,
        **options,
    )
    click.echo("STOPPED " + ", ".join(f"{name} {count}" for name, count in counts.items()))


def _print_ready(bundle: Path, state: ServiceState) -> None:
    named = f" (replica {state.replica})" if state.replica else ""
    failures = describe_failures(state.failures, state.shows_failures)
    http = f", control at {state.http}" if state.http else ""
    addresses = f"events at {state.sub}, answers at {state.pub}{failures}{http}"
    click.echo(f"READY {bundle}{named}: {addresses}, process {state.pid}.")
    if state.http:
        key = "" if _is_log(sys.stdout) else Path(state.access_key_file).read_text(encoding="utf-8").strip()
        click.echo(f"Live page: {state.http}/{f'?access_key={key}' if key else ''}")
        click.echo(f"Its access key, which allows changes, is in {state.access_key_file}")


def _is_log(stream: TextIO) -> bool:
    """Whether others may read later what is written: in a file, or in systemd's journal, which is a socket."""
    mode = os.fstat(stream.fileno()).st_mode
    return stat.S_ISREG(mode) or stat.S_ISSOCK(mode)


@command("epypes stop services/edges")
@source_argument
@seconds_option("--timeout", 30.0, "Longest wait for its end")
@replica_option
def stop(source: str, timeout_s: float, replica: str) -> None:
    """Stop a running service; accepted events are answered first.

    SIGTERM goes to all services of the bundle that this user runs on this machine, or to one named replica.
    """
    states = states_of(source, replica)
    end_s = monotonic() + min(timeout_s, TIMEOUT_MAX)
    late = []
    with ExitStack() as opened:
        # All are ended before the first is waited for.
        for state, process in [(state, _terminate(state, opened)) for state in states]:
            if process is None or select.select([process], [], [], max(end_s - monotonic(), 0.0))[0]:
                named = f", replica {state.replica}" if state.replica else ""
                click.echo(f"STOPPED {without_access_key(source)}{named}, process {state.pid}.")
            else:
                late.append(f"Process {state.pid}, which serves {source},")
    if late:
        raise ServiceError(source, f"{' '.join(late)} has not ended within {timeout_s:g} s. Wait longer: --timeout.")


def _terminate(state: ServiceState, opened: ExitStack) -> int | None:
    """Send SIGTERM to a process; return its file descriptor, or None if it has ended already.

    Unlike a process number, the descriptor never means a later process.
    """
    try:
        process = os.pidfd_open(state.pid)
        opened.callback(os.close, process)
        signal.pidfd_send_signal(process, signal.SIGTERM)
    except ProcessLookupError:
        return None
    return process


@command("epypes set services/edges canny_lo=90 blur_kernel=5", name="set")
@source_argument
@click.argument("values", nargs=-1, required=True, help="NAME=VALUE, as sigma=1.4 or method=sobel.")
@access_key_option
@replica_option
def set_parameters(source: str, values: Sequence[str], access_key_file: Path | None, replica: str) -> None:
    """Set hyperparameters of a running service.

    All values change together, between two events. Replicas that share a queue take them over. epypes deploy resets
    them.
    """
    wanted = dict(_parse_assignment(text) for text in values)
    with connect_to(source, access_key_file, replica) as service:
        before = service.parameters().entries
        now = service.set(**wanted)
    old, new = ({name: json.dumps(entries[name].get("value")) for name in wanted} for entries in (before, now.entries))
    changes = ", ".join(f"{name} {old[name]} -> {new[name]}" for name in wanted)
    click.echo(f"SET {changes}: revision {now.revision}.")


def _parse_assignment(text: str) -> tuple[str, Any]:
    """Return name and value: JSON if it is that, else the text itself."""
    name, sign, value = text.partition("=")
    if not sign or not name:
        raise ServiceError(text, f"{text!r} sets nothing. Write NAME=VALUE, as sigma=1.4.")
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value


@command("epypes reset services/lane --source left")
@source_argument
@click.option("--source", "event_source", help="Source of events whose state alone is reset.", show_default="all")
@access_key_option
@replica_option
def reset(source: str, event_source: str | None, access_key_file: Path | None, replica: str) -> None:
    """Reset the state between events of a running service.

    The next event begins with the initial values of the delays, as the first one did. Stopping a service resets its
    state too; a worker that dies does not.
    """
    # Of several replicas each has the states of the sources whose events it gets.
    urls = [] if is_url(source) else [state.http for state in states_of(source, replica) if state.http]
    refusals = []
    for url in urls or [source]:
        try:
            with connect_to(url, access_key_file, replica) as service:
                service.reset(event_source)
        except ServiceError as error:
            refusals.append(error)
    if len(refusals) == max(len(urls), 1):
        raise refusals[0]
    for refusal in refusals:
        click.echo(f"{refusal}", err=True)
    of = "" if event_source is None else f" of source {event_source}"
    click.echo(f"RESET the state between events{of}.")


@command("epypes deploy services/edges_2 --http http://127.0.0.1:8642")
@click.argument("bundle", type=PATH, help="Folder of the bundle, on the service's machine.")
@_service_option
@_state_option
@access_key_option
def deploy(bundle: Path, source: str, state: StateChoice | None, access_key_file: Path | None) -> None:
    """Deploy another bundle to a running service.

    The service replays the bundle first; if it computes something else, the service keeps the old one.
    """
    with connect_to(source, access_key_file) as connection:
        before = connection.info()
        click.echo(f"{bundle} is replayed beside {before['bundle']}, which goes on meanwhile.", err=True)
        _print_exchange("DEPLOYED", before, connection.deploy(bundle, state))


@command("epypes rollback --http http://127.0.0.1:8642")
@_service_option
@_state_option
@access_key_option
def rollback(source: str, state: StateChoice | None, access_key_file: Path | None) -> None:
    """Return a running service to its previous bundle.

    A second rollback returns to the bundle before the first.
    """
    with connect_to(source, access_key_file) as connection:
        _print_exchange("ROLLED BACK", connection.info(), connection.rollback(state))


def _print_exchange(verb: str, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    changed = "".join(f" {line}." for line in now.get("changed", ()))
    click.echo(f"{verb} {describe_bundle(now)} in place of {describe_bundle(before)}: {now['state']}.{changed}")
