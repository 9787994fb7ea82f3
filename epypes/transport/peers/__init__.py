"""Middleware from peer to peer, without a broker: DDS and Zenoh.

`channel.PeerChannel` implements `epypes.transport.channel.Channel` once for all of them. `dds` and `zenoh` are sessions
of one middleware each: open, send, close.

Options of ``dds://DOMAIN/TOPIC``:

``type=sensor_msgs/msg/Image``
    The messages are of this type of ROS 2, and the topic has ``rt/`` before its name; without it, they are EPypes'
    envelopes.
``token=edges``
    With a type of ROS 2: the part that is published, where several fit, and the name of the part that is received,
    which a service takes from its bundle.
``reliability=reliable|best_effort``, ``history=5``, ``durability=volatile|transient_local``
    QoS: whether lost messages are sent again, how many are kept, and whether a late joiner gets them. Without
    ``history``, a publisher keeps 256 for a subscriber that is behind and 1 for late joiners, and a subscriber 1,000
    until Python takes them. Cyclone DDS bounds them by their number alone, as ZeroMQ does: while other code holds
    Python's lock for seconds, each of those may be an image.
``deadline=0.5``, ``lease=2``
    Seconds without a message, or without a sign of life of a publisher, after which the input is stale.
``interface=127.0.0.1``
    The network interface, by its address or name; without it, nothing leaves this machine, unless CYCLONEDDS_URI
    configures Cyclone DDS.

Options of ``zenoh://HOST[:PORT]/KEY``:

``type=sensor_msgs/msg/Image``, ``domain=0``
    The messages are of this type of ROS 2, in a domain of rmw_zenoh; without it, they are EPypes' envelopes.
``token=edges``
    As for DDS.
``congestion=drop|block``
    What happens to a message for which a subscriber or the network is too slow. It is dropped: the first one after 1 s,
    those behind it at once. Or the publisher waits, and disconnects the subscriber after 5 s.
``priority=data``
    Messages of a higher priority overtake others: ``real_time``, ``interactive_high``, ``interactive_low``,
    ``data_high``, ``data``, ``data_low`` or ``background``.
``ca=FILE``, ``password_file=FILE``
    The certificates that an encrypted router is checked by, and the file with the password of USER.
"""
