"""Compiler of ``proto/`` into ``schema.binpb``: ``python -m epypes.wire.compile``."""

from __future__ import annotations

import importlib
import logging
import tempfile
from pathlib import Path

from epypes.wire.protobuf import SCHEMA_PATH

PROTO_FILES = ("epypes2019/messages.proto", "epypes/v1/envelope.proto")

log = logging.getLogger("epypes.wire")


def compiled(proto_dir: Path) -> bytes:
    """Compile the messages of a checkout.

    Parameters
    ----------
    proto_dir
        The folder ``proto/``. File names in the result are relative to it, so that they carry a folder and
        never clash with a user's own ``messages.proto``.

    Returns
    -------
    bytes
        A serialized ``google.protobuf.FileDescriptorSet``.

    Raises
    ------
    RuntimeError
        If protoc refuses the files.
    """
    # grpcio-tools is needed by developers alone, and has no type hints.
    protoc = importlib.import_module("grpc_tools.protoc")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "schema.binpb"
        arguments = [f"-I{proto_dir}", f"--descriptor_set_out={out}", "--include_imports", *PROTO_FILES]
        status = protoc.main(["protoc", *arguments])
        if status != 0:
            raise RuntimeError(f"protoc refused the files of {proto_dir} (exit status {status})")
        return out.read_bytes()


def main() -> None:
    """Write ``schema.binpb`` beside this module from the checkout's ``proto/``."""
    schema = compiled(SCHEMA_PATH.parents[2] / "proto")
    SCHEMA_PATH.write_bytes(schema)
    log.info("%s: %d bytes", SCHEMA_PATH, len(schema))


if __name__ == "__main__":
    main()
