"""Groups of replicas whose workers take every change at once."""

from __future__ import annotations

import itertools
import threading
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from epypes.errors import BrokerError, ParametersRefused, RevisionConflict, ServiceError
from epypes.service.group.group import Group
from epypes.service.group.membership import Member
from epypes.service.group.notices import written
from epypes.service.group.revisions import Proposal
from epypes.service.parameters import Parameters, changed_entries, with_value
from epypes.transport.channels import memory, open_channel, place_of
from epypes.wire import Envelope
from tests.service.served import TIMEOUT_S, until

pytestmark = pytest.mark.slow

_numbers = itertools.count(1)


class Values:
    """The parameters of a replica whose worker takes every whole number but 13."""

    def __init__(self, digest="d1"):
        self.path, self.digest = Path("/bundle"), digest
        self.own = {"k": {"value": 2, "low": 0, "high": 1_000}}
        self.current = Parameters(0, self.own)
        self.turn = threading.Lock()
        self.is_busy = False
        self.refused = None

    def planned(self, values, revision):
        with self.turn:
            if revision not in (None, self.current.revision):
                raise RevisionConflict(self.path, self.current)
            after, problems = changed_entries(self.current.entries, values)
            if not problems and after["k"]["value"] == 13:
                problems = {"k": "13 brings bad luck"}
            if problems:
                raise ParametersRefused(self.path, problems)
            return self.current if after == self.current.entries else Parameters(self.current.revision + 1, after)

    def follow(self, digest, revision, values):
        with self.turn:
            if self.is_busy:
                raise ServiceError(self.path, "There is no worker just now.")
            after = {"k": with_value(self.own["k"], values.get("k", self.own["k"]))}
            if after["k"]["value"] == self.refused:
                return {"k": "not here"}
            self.current = Parameters(revision, after)
            return {}


@pytest.fixture
def place():
    """A place of a broker of its own."""
    return place_of(f"memory://agree{next(_numbers)}/events?create=true")


class Replica:
    """A group, as one replica has it, without a service around it."""

    def __init__(self, place, name, digest="d1", timeout_s=None):
        self.values, self.name = Values(digest), name
        self.seen, self.passed, self.stood_still = [], [], []
        heard = self.seen.extend, lambda: None, self.stood_still.append
        self.group = Group(place, self.about, self.values, *heard, timeout_s)

    def about(self, own_id):
        return Member(
            own_id, self.name, state="READY", digest=self.values.digest, revision=self.values.current.revision
        )

    @property
    def is_current(self):
        return self.group.agreement.is_current

    def set(self, k, revision=None):
        return self.group.agreement.set({"k": k}, revision)

    def shown(self):
        return self.values.current.revision, self.values.current.entries["k"]["value"]

    def finish(self, event):
        """Compute an event's answer, which is published when its turn has come."""
        self.group.wait_turn(event, lambda has_overtaken: self.publish(event, has_overtaken))

    def publish(self, event, has_overtaken):
        self.passed.append(event.sequence)
        self.group.done(event, has_overtaken)


@contextmanager
def started(*replicas):
    with ThreadPoolExecutor(len(replicas)) as pool, ExitStack() as stack:
        for replica in replicas:
            replica.group.start()
            stack.callback(pool.submit, replica.group.stop)
        for replica in replicas:
            until(lambda replica=replica: replica.is_current)
            until(lambda replica=replica: len(replica.group.present()) >= len(replicas))
        yield


def group_of(place, count=3, **options):
    return [Replica(place, str(number), **options) for number in range(1, count + 1)]


def test_a_change_at_one_reaches_all(place):
    replicas = group_of(place)
    with started(*replicas):
        assert replicas[0].set(5, 0).revision == 1
        assert replicas[0].shown() == (1, 5), "it is made here when it is answered"
        until(lambda: [each.shown() for each in replicas] == [(1, 5)] * 3)
        assert replicas[2].set(5).revision == 1, "it changes nothing"


def test_changes_at_once_are_made_by_all_or_by_none(place):
    replicas = group_of(place)
    with started(*replicas), ThreadPoolExecutor(3) as pool:
        for turn in range(20):
            before = turn
            until(lambda before=before: [each.shown()[0] for each in replicas] == [before] * 3)

            def change(number, before=before, turn=turn):
                try:
                    return replicas[number].set(10 * turn + number + 100, before).revision
                except RevisionConflict:
                    return None

            assert Counter(pool.map(change, range(3))) == {before + 1: 1, None: 2}
        until(lambda: len({each.shown() for each in replicas}) == 1)


def test_changes_of_whatever_revision_are_all_made_one_after_the_other(place):
    replicas = group_of(place)
    with started(*replicas), ThreadPoolExecutor(3) as pool:
        made = list(pool.map(lambda number: replicas[number].set(100 + number).revision, range(3)))
        assert sorted(made) == [1, 2, 3]
        until(lambda: len({each.shown() for each in replicas}) == 1)
        assert replicas[0].shown()[0] == 3


def test_what_is_refused_nobody_hears_of(place):
    first, second = replicas = group_of(place, 2)
    with started(*replicas):
        with pytest.raises(ParametersRefused):
            first.set(13)
        with pytest.raises(RevisionConflict):
            first.set(5, 4)
        assert not memory._broker(place.host).logs["events.parameters"]
        assert second.shown() == (0, 2)


def test_ids_and_sources_of_large_letters_are_said_to_others(place):
    first, second = replicas = group_of(place, 2, timeout_s=30.0)
    ids = [f"{number} {chr(0x1F600) * 60}" for number in range(1_000)]
    with started(*replicas):
        with memory.away(place.host):
            until(lambda: first.group.trouble != "")
            for number, known_as in enumerate(ids, 1):
                source = chr(0x1F600) * 250
                first.group.done(Envelope("number", id=known_as, source=source, epoch=1, sequence=number))
                first.group.done(Envelope("number", id=chr(0x1F600) * 250, source=source, epoch=1, sequence=number))
        until(lambda: set(ids) <= set(second.seen))
        assert second.group.rejected == 0


def test_who_joins_late_reads_what_was_agreed_on(place):
    first, late = group_of(place, 2)
    with started(first):
        for k in range(3, 10):
            first.set(k)
        with started(late):
            assert late.shown() == (7, 9)


def test_who_comes_after_another_has_left_is_heard(place):
    first, second, third = group_of(place)
    with started(first):
        with started(second):
            until(lambda: len(first.group.present()) == 2)
        until(lambda: len(first.group.present()) == 1)
        with started(third):
            until(lambda: [each.member.replica for each in first.group.present()] == ["1", "3"])


def test_a_change_waits_for_a_worker(place):
    first, second = replicas = group_of(place, 2)
    with started(*replicas):
        second.values.is_busy = True
        first.set(5)
        until(lambda: second.group.agreement.agreed == 1)
        assert second.shown() == (0, 2)
        assert not second.is_current
        second.values.is_busy = False
        until(lambda: second.shown() == (1, 5))


def test_a_worker_that_does_not_take_what_others_took_is_told_of(place):
    first, second = replicas = group_of(place, 2)
    second.values.refused = 5
    with started(*replicas):
        first.set(5)
        until(lambda: "does not take revision 1" in second.group.trouble)
        until(lambda: any("not here" in each["trouble"] for each in first.group.told()["members"]))
        assert first.group.told()["agree"] is False
        first.set(6)
        until(lambda: second.shown() == (2, 6))
        assert second.group.trouble == ""


def test_who_was_cut_off_catches_up_and_is_heard_again(place):
    first, second = replicas = group_of(place, 2)
    with started(*replicas):
        first.set(3)
        with memory.away(place.host):
            until(lambda: first.group.trouble != "")
            with pytest.raises(ServiceError, match="group can't be reached"):
                first.set(4)
            entry = Proposal("elsewhere", "d1", 1, 2, {"k": {"value": 9}})
            memory._broker(place.host).logs["events.parameters"].append(
                memory._Message((written(entry),), "elsewhere", {})
            )
        until(lambda: [each.shown() for each in replicas] == [(2, 9)] * 2)
        until(lambda: first.group.trouble == second.group.trouble == "")
        until(lambda: len(first.group.present()) == 2)
        assert second.set(4, 2).revision == 3


def test_a_bundle_that_nobody_knows_is_introduced(place):
    first, second = replicas = group_of(place, 2)
    with started(*replicas):
        first.set(5)
        # Another bundle takes over at one of them, with the next revision.
        assert first.group.agreement.taken_over("d2") is None
        first.values.digest, first.values.current = "d2", Parameters(2, first.values.own)
        until(lambda: first.group.agreement.agreed == 2)
        until(lambda: second.group.agreement.taken_over("d2") is not None)
        revision, values = second.group.agreement.taken_over("d2")
        assert (revision, values["k"]) == (2, {"value": 2})
        assert second.shown()[0] == 1


def test_who_goes_on_knowing_less_is_told_again(place):
    # As with a log that keeps its newest entry alone, when that is another bundle's.
    first, second = group_of(place, 2)
    with started(first):
        first.set(5)
        log = memory._broker(place.host).logs["events.parameters"]
        log[:] = [memory._Message((written(Proposal("other", "d9", 0, 1, {})),), "other", {})]
        with started(second):
            until(lambda: second.shown() == (1, 5))


def test_what_another_program_says_is_passed_over(place):
    first, second = replicas = group_of(place, 2)
    with started(*replicas):
        for name, kind in (("group", "broadcast"), ("parameters", "log")):
            channel = open_channel(place.beside(name, kind))
            for data in (b"hello", b'{"v":1,"kind":"beat"}', b'{"v":9}'):
                channel.send((data,))
            channel.close()
        until(lambda: (first.group.rejected, first.group.agreement.rejected) == (3, 3), TIMEOUT_S)
        first.set(5)
        until(lambda: second.shown() == (1, 5))


def test_others_hear_of_what_is_done(place):
    first, second = replicas = group_of(place, 2)
    events = [Envelope(type="x", sequence=number, source="camera", epoch=1) for number in range(1, 5_001)]
    with started(*replicas):
        for event in events:
            first.group.done(event)
        until(lambda: len(second.seen) == len(events))
        assert second.seen == [event.id for event in events]
        assert first.seen == []


def test_what_is_done_while_the_broker_is_away_is_told_afterwards(place):
    first, second = replicas = group_of(place, 2)
    event = Envelope(type="x")
    with started(*replicas):
        with memory.away(place.host):
            until(lambda: first.group.trouble != "")
            first.group.done(event)
        until(lambda: second.seen == [event.id])


def test_answers_of_all_replicas_are_published_in_order(place):
    first, second = replicas = group_of(place, 2, timeout_s=TIMEOUT_S)
    events = [Envelope(type="x", sequence=number, source="camera", epoch=1) for number in range(1, 41)]
    published = []
    for replica in replicas:
        publish = replica.publish
        replica.publish = lambda event, late, publish=publish: (published.append(event.sequence), publish(event, late))
    with started(*replicas):
        for replica, own in ((first, events[0::2]), (second, events[1::2])):
            for event in own:
                replica.group.arrived(event)
            for event in reversed(own):
                replica.finish(event)
        until(lambda: len(published) == len(events))
        assert published == [event.sequence for event in events]
        assert first.group.overtaken == second.group.overtaken == 0


def test_it_is_told_how_many_answers_wait_when_none_passes_for_a_while_and_that_it_is_over(place):
    (replica,) = group_of(place, 1, timeout_s=TIMEOUT_S)
    events = [Envelope(type="x", sequence=number, source="camera", epoch=1) for number in range(1, 5)]
    with started(replica):
        replica.finish(events[0])
        until(lambda: replica.passed == [1])
        assert replica.stood_still == []
        replica.finish(events[2])
        until(lambda: replica.stood_still == [1])
        replica.finish(events[3])
        until(lambda: replica.stood_still == [1, 2])
        replica.finish(events[1])
        until(lambda: replica.stood_still == [1, 2, 0])
    assert replica.passed == [1, 2, 3, 4]
    assert replica.group.overtaken == 0


def test_with_an_order_an_event_is_acknowledged_once_the_others_are_told(place, monkeypatch):
    first, second = replicas = group_of(place, 2, timeout_s=TIMEOUT_S)
    told = []
    with started(*replicas):
        say = first.group._talk.say
        monkeypatch.setattr(first.group._talk, "say", lambda data: (say(data), told.append("said")))
        event = Envelope(type="x", sequence=1, source="camera", epoch=1)
        first.group.done(event, acknowledge=lambda: told.append(event.id))
        until(lambda: event.id in told)
        assert "said" in told[: told.index(event.id)]
        until(lambda: second.seen == [event.id])
        with memory.away(place.host):
            until(lambda: first.group.trouble != "")
            # Nobody can be told, and the events to come shall not wait for that.
            first.group.done(event, acknowledge=lambda: told.append("away"))
            assert told[-1] == "away"
    first.group.done(event, acknowledge=lambda: told.append("over"))
    assert told[-1] == "over"


def test_without_an_order_an_event_is_acknowledged_at_once(place):
    (replica,) = group_of(place, 1)
    told = []
    with started(replica):
        replica.group.done(Envelope(type="x", sequence=1), acknowledge=lambda: told.append("acknowledged"))
        assert told == ["acknowledged"]


def test_an_event_without_a_number_waits_for_nobody(place):
    (replica,) = group_of(place, 1, timeout_s=TIMEOUT_S)
    passed = []
    with started(replica):
        replica.group.wait_turn(b"bytes", passed.append)
        replica.group.wait_turn(Envelope(type="x"), passed.append)
        assert passed == [False, False]


def test_an_answer_goes_on_without_an_event_that_nobody_has(place):
    first, second = replicas = group_of(place, 2, timeout_s=0.3)
    with started(*replicas):
        for number in (1, 3):
            first.finish(Envelope(type="x", sequence=number, source="camera", epoch=1))
        until(lambda: first.passed == [1, 3])
        assert first.group.overtaken == 1
        second.finish(Envelope(type="x", sequence=4, source="camera", epoch=1))
        until(lambda: second.passed == [4])
        assert second.group.overtaken == 0, "the others have given it up too"


def test_what_waits_is_not_published_when_a_replica_ends(place):
    (replica,) = group_of(place, 1, timeout_s=0.5)
    with started(replica):
        replica.group.arrived(Envelope(type="x", sequence=1, source="camera", epoch=1))
        replica.finish(Envelope(type="x", sequence=2, source="camera", epoch=1))
        replica.group.give_up()
        replica.group.stop()
        assert replica.passed == []


def test_a_group_whose_broker_is_not_there_stops_at_once_and_raises_nothing(place):
    with memory.away(place.host):
        (replica,) = group_of(place, 1)
        replica.group.start()
        with pytest.raises(BrokerError):
            open_channel(place)
        assert "can't be reached" in replica.group.trouble or "not been reached" in replica.group.trouble
        assert replica.group.told()["replicas"] == 1
        replica.group.stop()
        replica.group.stop()


def test_nobody_tries_again_and_again_while_the_broker_is_away(place):
    (replica,) = group_of(place, 1, timeout_s=TIMEOUT_S)
    with started(replica), memory.away(place.host):
        until(lambda: replica.group.trouble != "")
        replica.group.arrived(Envelope(type="x", sequence=7, source="camera", epoch=1))
        replica.group.done(Envelope(type="x", sequence=7, source="camera", epoch=1))
        turns, say = [], replica.group._say
        replica.group._say = lambda notices: (turns.append(notices), say(notices))
        until(lambda: len(turns) >= 2)
        assert len(turns) < 20


def said(place, *entries):
    """Say something in the log of a group, as another program might."""
    channel = open_channel(place.beside("parameters", "log", create=True))
    for entry in entries:
        channel.send((written(entry),))
    channel.close()


def test_many_changes_at_once_at_all_replicas_are_all_made(place):
    replicas = group_of(place)
    with started(*replicas), ThreadPoolExecutor(20) as pool:
        made = list(pool.map(lambda number: replicas[number % 3].set(100 + number).revision, range(20)))
        assert sorted(made) == list(range(1, 21))
        until(lambda: [each.shown()[0] for each in replicas] == [20] * 3)


def test_what_no_worker_takes_can_be_changed_at_any_replica(place):
    replicas = group_of(place)
    for replica in replicas:
        replica.values.refused = 666
    with started(*replicas):
        said(place, Proposal("foreign", "d1", 0, 5, {"k": {"value": 666}}))
        until(lambda: all("does not take revision 5" in each.group.trouble for each in replicas))
        assert replicas[1].set(2).revision == 6, "what it has already, the group has not"
        until(lambda: [each.shown() for each in replicas] == [(6, 2)] * 3)
        assert not any(each.group.trouble for each in replicas)


def test_after_a_revision_that_nobody_can_count_on_from_changes_go_on(place):
    replicas = group_of(place, 2)
    with started(*replicas):
        said(place, Proposal("foreign", "d1", 2**63 - 2, 2**63 - 1, {"k": {"value": 7}}))
        assert replicas[0].set(5).revision == 1
        until(lambda: replicas[1].shown() == (1, 5))


def test_a_fault_of_this_program_does_not_end_what_it_hears(place, caplog):
    first, second = replicas = group_of(place, 2)
    with started(*replicas):
        second.values.follow, follow = None, second.values.follow
        first.set(5)
        until(lambda: "at memory" in caplog.text)
        second.values.follow = follow
        until(lambda: second.shown() == (1, 5))


def test_a_replica_without_an_order_tells_those_that_keep_one(place):
    ordered, other = Replica(place, "1", timeout_s=30.0), Replica(place, "2")
    first, second, third = (Envelope("number", source="cam", epoch=1, sequence=number) for number in (1, 2, 3))
    with started(ordered, other):
        ordered.finish(first)
        ordered.finish(third)
        until(lambda: ordered.passed == [1])
        other.finish(second)
        until(lambda: ordered.passed == [1, 3])
        assert ordered.group.overtaken == 0
