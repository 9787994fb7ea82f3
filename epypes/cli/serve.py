"""``epypes serve``: a bundle as a running service."""

from __future__ import annotations

import contextlib
import logging
import resource
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TextIO, cast

import typer

from epypes.cli.options import Allow, Keys
from epypes.cli.terminal import failures_at, out

if TYPE_CHECKING:
    from epypes.service.state_file import ServiceState

_ANY_PORT = "tcp://127.0.0.1:*"


def serve(
    bundle: Annotated[Path, typer.Argument(help="The folder of the bundle.")],
    sub: Annotated[
        str,
        typer.Option(
            help="Where events come from: an address to bind, connect:ADDRESS, or a broker's queue, as amqp://HOST/QUEUE."
        ),
    ] = _ANY_PORT,
    pub: Annotated[
        str, typer.Option(help="Where answers go: an address to bind, connect:ADDRESS, or a broker's queue.")
    ] = _ANY_PORT,
    failures: Annotated[
        str,
        typer.Option(help="Extra address that receives only failures, as --pub. Failures also arrive as answers."),
    ] = _ANY_PORT,
    http: Annotated[str, typer.Option(help="Address of the HTTP control, as 127.0.0.1:8642; none without.")] = "",
    threads: Annotated[
        int, typer.Option(help="How many events are worked on at once, in order; at most 64.", min=1, max=64)
    ] = 1,
    job_timeout: Annotated[
        float, typer.Option(help="How long an event may take, in seconds; then the worker is replaced.", min=0.01)
    ] = 30.0,
    drain_timeout: Annotated[
        float, typer.Option(help="How long SIGTERM waits for accepted events, in seconds.", min=0.0)
    ] = 5.0,
    retries: Annotated[int, typer.Option(help="How often an event that kills the worker is tried again.", min=0)] = 1,
    mailbox: Annotated[str, typer.Option(help="What is dropped when too many wait: drop_oldest, latest, fault.")] = (
        "drop_oldest"
    ),
    mailbox_size: Annotated[int, typer.Option(help="How many events wait; 1 for latest.", min=1)] = 8,
    insecure: Annotated[bool, typer.Option(help="Bind addresses that other machines can reach.")] = False,
    keys: Keys = None,
    allow: Allow = None,
    token_file: Annotated[Path | None, typer.Option(help="File of the token for HTTP; one is made without.")] = None,
    store: Annotated[
        str | None,
        typer.Option(
            help="Where a row of each event is kept: a SQLite file (extra store), or a database's URL (extra postgres)."
        ),
    ] = None,
    replica: Annotated[
        str, typer.Option(help="Name of this replica among those that share a broker's queue; a number without.")
    ] = "",
) -> None:
    """Serve a bundle between a SUB and a PUB socket, or a broker's queues, until SIGTERM or Ctrl+C.

    A broker's address is amqp://, nats:// or mqtt://[USER@]HOST/NAME.

    Its password is in a file, which ?password_file=PATH names: lists of processes show addresses.

    More options follow with & (quote the address): create=true, attempts=3, dead=NAME, group=NAME, kind=broadcast,
    vhost=NAME, ca=FILE.
    """
    from epypes.service import serve as serve_bundle
    from epypes.service.standard_error import STANDARD_ERROR

    # Nobody may read it: no thread of the service waits for that.
    handler = logging.StreamHandler(cast("TextIO", STANDARD_ERROR))
    logging.basicConfig(
        level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s", handlers=[handler]
    )

    # Connections take descriptors; the soft limit is often 1,024, for programs that call select().
    with contextlib.suppress(OSError, ValueError):
        hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))

    def on_ready(state: ServiceState) -> None:
        more = f", control at {state.http}" if state.http else ""
        where = (
            f"events at {state.sub}, answers at {state.pub}{failures_at(state.failures, state.shows_failures)}{more}"
        )
        named = f" (replica {state.replica})" if state.replica else ""
        out.print(f"READY {bundle}{named}: {where}, process {state.pid}.")
        if state.http:
            # A log is read by others than a terminal.
            token = f"#token={Path(state.token_file).read_text(encoding='utf-8').strip()}" if out.is_terminal else ""
            out.print(f"Live page: {state.http}/{token} (the token for changes is in {state.token_file})")

    def on_fault(reason: str) -> None:
        STANDARD_ERROR.write(f"FAULTED {bundle}: {reason}\n")

    counts = serve_bundle(
        bundle,
        sub,
        pub,
        failures=failures,
        http=http,
        token_file=token_file,
        threads=threads,
        job_timeout_s=job_timeout,
        drain_timeout_s=drain_timeout,
        retries=retries,
        mailbox_policy=mailbox,
        mailbox_size=1 if mailbox == "latest" else mailbox_size,
        insecure=insecure,
        keys=keys,
        allow=allow,
        store=store,
        replica=replica,
        on_ready=on_ready,
        on_fault=on_fault,
    )
    out.print("STOPPED " + ", ".join(f"{name} {count}" for name, count in counts.items()))
