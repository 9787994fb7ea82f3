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
    help="URL of the service, such as http://127.0.0.1:8642, or the folder of the bundle that it was started with.",
)


_state_option: Final = click.option(
    "--state",
    type=click.Choice(["keep", "reset"]),
    show_default="keep if both bundles delay the same tokens",
    help="Keep or reset the state between events (ep.delay).",
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
@click.option("--sub", default=_ANY_PORT, help="Address that events come from.")
@click.option("--pub", default=_ANY_PORT, help="Address that answers go to.")
@click.option("--failures", default=_ANY_PORT, help="Extra address that receives only failures.")
@click.option("--http", default="", help="Address of the live page and of HTTP control.", show_default="none")
@click.option(
    "--threads",
    type=click.IntRange(1, 64),
    default=1,
    help="Number of events to compute at the same time. Answers keep the order of the events; with --state-per source "
    "those of each source.",
)
@seconds_option("--job-timeout", 30.0, "Seconds that one event may take; then the worker is replaced.", least=0.01)
@seconds_option("--drain-timeout", 5.0, "Seconds to answer accepted events after SIGTERM.")
@click.option("--retries", type=click.IntRange(0), default=1, help="Number of retries if an event crashes the worker.")
@click.option(
    "--mailbox",
    default="drop_oldest",
    help="Policy when too many events wait: drop_oldest, latest (only the newest waits) or fault (refuse the new one).",
)
@click.option("--mailbox-size", type=click.IntRange(1), default=8, help="Number of events that may wait.")
@insecure_option
@keys_option
@allow_option
@click.option("--access-key-file", type=PATH, help="File of the access key for HTTP; created if missing.")
@click.option("--store", help="SQLite file or PostgreSQL URL, for one row per event.")
@click.option(
    "--replica", default="", show_default="a number", help="Name among services that share a broker's events."
)
@click.option(
    "--state-per",
    type=click.Choice(["one", "source"]),
    default="one",
    help="Keep one state between events (ep.delay) for all events, or one for each source of events (camera).",
)
@click.option(
    "--partitioned", is_flag=True, help="Declare that the broker sends all events of a source to one replica."
)
def serve(bundle: Path, sub: str, pub: str, mailbox: str, mailbox_size: int, **options: Any) -> None:
    """Serve a bundle until SIGTERM or Ctrl+C.

    A worker process computes the graph for each event, and the service publishes an answer: the output tokens, or the
    failure. Without --sub and --pub it binds free ports of this machine, which epypes call finds.

    \b
    Addresses:
    tcp://HOST:PORT           - ZeroMQ; the service binds it
    connect:tcp://HOST:PORT   - ZeroMQ; the service connects to it
    amqp://HOST/QUEUE         - RabbitMQ; encrypted: amqps
    nats://HOST/SUBJECT       - NATS JetStream; encrypted: tls
    mqtt://HOST/TOPIC         - MQTT 5; encrypted: mqtts
    dds://DOMAIN/TOPIC        - DDS and ROS 2, without a broker
    zenoh://127.0.0.1/KEY     - Zenoh, without a broker; through a router: zenoh://HOST:PORT/KEY

    \b
    Options of a broker's address, after ? and separated by & (quote the address):
    create=true               - create the queue if it is missing
    password_file=FILE        - password for USER@HOST; process lists show addresses
    ca=FILE                   - certificate authority of the broker
    attempts=3                - largest number of deliveries of one event
    dead=NAME                 - queue for events that were delivered too often
    group=NAME                - replicas that share the events (NATS, MQTT)
    kind=broadcast            - send to all consumers, keep nothing
    vhost=NAME                - virtual host of RabbitMQ

    \b
    Options of DDS and Zenoh, of which the guides "ROS 2 and DDS" and "Zenoh" list more:
    type=TYPE                 - messages of ROS 2, such as sensor_msgs/msg/Image
    token=NAME                - with type=: token that is published
    interface=NAME            - network interface (DDS); without it, this machine alone
    """  # noqa: D301 - click keeps the lines of a paragraph that begins with it
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
@seconds_option("--timeout", 30.0, "Seconds to wait until the service has ended.")
@replica_option
def stop(source: str, timeout_s: float, replica: str) -> None:
    """Stop a running service; accepted events are answered first.

    The command sends SIGTERM to all services of the bundle that you run on this machine, or to one replica.
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
@click.argument("values", nargs=-1, required=True, help="NAME=VALUE, such as sigma=1.4 or method=sobel.")
@access_key_option
@replica_option
def set_parameters(source: str, values: Sequence[str], access_key_file: Path | None, replica: str) -> None:
    """Change hyperparameters of a running service.

    All values change together, between two events, and in all replicas. epypes deploy replaces them by those of the
    new bundle.
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
@click.option("--source", "event_source", help="Reset the state of this source of events alone.", show_default="all")
@access_key_option
@replica_option
def reset(source: str, event_source: str | None, access_key_file: Path | None, replica: str) -> None:
    """Reset the state between events (ep.delay) of a running service.

    The next event is computed with the initial values. Stopping a service resets its state too; a worker process that
    ends does not.
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
@click.argument("bundle", type=PATH, help="Folder of the new bundle, on the machine of the service.")
@_service_option
@_state_option
@access_key_option
def deploy(bundle: Path, source: str, state: StateChoice | None, access_key_file: Path | None) -> None:
    """Replace the bundle of a running service.

    The service replays the samples of the new bundle first. If a token differs, it keeps the old bundle. The change
    happens between two events.
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
    """Undo the last deploy of a running service.

    A second rollback undoes the first.
    """
    with connect_to(source, access_key_file) as connection:
        _print_exchange("ROLLED BACK", connection.info(), connection.rollback(state))


def _print_exchange(verb: str, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    changed = "".join(f" {line}." for line in now.get("changed", ()))
    click.echo(f"{verb} {describe_bundle(now)} in place of {describe_bundle(before)}: {now['state']}.{changed}")
