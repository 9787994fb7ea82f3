"""A FullPipeline between a ZeroMQ subscriber and a publisher, which send the messages of 2019."""

import pickle
import socket
import time

import numpy as np
import zmq
from epypes.compgraph import CompGraph
from epypes.pipeline import FullPipeline
from epypes.protobuf.pbtypes import Event, JustBytes  # isort: skip
from epypes.protobuf.pbprocess import add_attribute
from epypes.queue import Queue
from epypes.zeromq import ZeroMQPublisher, ZeroMQSubscriber


def free_port():
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


def dispatch_event(msg):
    event = Event()
    event.ParseFromString(msg)
    return {"numbers": np.frombuffer(event.id.encode(), np.uint8)}


def prepare_output(pipe):
    message = JustBytes()
    message.contents = pickle.dumps(pipe.token_value("doubled"))
    add_attribute(message, "system", pipe.get_attr("system"))
    add_attribute(message, "time", pipe.time)
    return message.SerializeToString()


cg = CompGraph({"double": lambda x, factor: x.astype(int) * factor}, {"double": (("numbers", "factor"), "doubled")})
q_in, q_out = Queue(), Queue()
pipe = FullPipeline(
    "doubling",
    cg,
    q_in,
    q_out,
    event_dispatcher=dispatch_event,
    out_prep_func=prepare_output,
    frozen_tokens={"factor": 2},
)
pipe.set_attr("system", "tests")

requests, answers = (f"tcp://127.0.0.1:{free_port()}" for _ in range(2))
context = zmq.Context()
peer_pub, peer_sub = context.socket(zmq.PUB), context.socket(zmq.SUB)
peer_pub.bind(requests)

subscriber = ZeroMQSubscriber(requests, q_in)
publisher = ZeroMQPublisher(answers, q_out)
publisher.start()
pipe.listen()
subscriber.start()
peer_sub.connect(answers)
peer_sub.setsockopt_string(zmq.SUBSCRIBE, "")

event = Event()
event.type, event.id = "request", "abc"
deadline = time.monotonic() + 60
while not peer_sub.poll(50):  # PUB sends nothing to those that have not joined yet
    assert time.monotonic() < deadline
    peer_pub.send(event.SerializeToString())
answer = JustBytes()
answer.ParseFromString(peer_sub.recv())
assert pickle.loads(answer.contents).tolist() == [194, 196, 198]
attributes = {entry.key: entry for entry in answer.attributes.entries}
assert attributes["system"].str_val == "tests"
assert attributes["time"].double_val >= 0

q_out.put("a text")
while peer_sub.recv() != b"a text":  # answers to the other requests come first
    assert time.monotonic() < deadline

subscriber.stop()
pipe.stop()
publisher.stop()
subscriber.join()
publisher.join()
context.destroy(linger=0)
