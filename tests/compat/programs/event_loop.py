"""A CommonEventLoop that calls a function for each item of a queue."""

from epypes.loop import CommonEventLoop
from epypes.queue import Queue, create_queue_putter

q_in, q_out = Queue(), Queue()
loop = CommonEventLoop(q=q_in, callback_func=create_queue_putter(lambda x: x * x, q_out))
loop.start()
for number in range(4):
    q_in.put(number)
assert [q_out.get(timeout=60) for _ in range(4)] == [0, 1, 4, 9]
loop.stop()
loop.join()
