"""Message brokers: RabbitMQ, NATS JetStream and MQTT 5.

`channel.BrokerChannel` implements `epypes.transport.channel.Channel` once for all of them. `amqp`, `nats` and `mqtt`
are sessions of one broker each: connect, publish until confirmed, consume, settle, close.
"""
