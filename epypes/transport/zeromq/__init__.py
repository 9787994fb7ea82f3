"""ZeroMQ: sockets on one I/O thread, as channels; joining without loss, heartbeats, CURVE keys, bounded connections."""
