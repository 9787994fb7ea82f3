// Which message counts, whatever the order they come in?

/**
 * What a view remembers of the numbers of its messages.
 *
 * A frame is shown if none newer has come; every frame is acknowledged once it is painted, or can't be.
 */
export function arrivals() {
  let received = 0;
  let painted = 0;
  let good = 0;
  /** @type {null | {seq: number, text: string, function?: string, names?: string[]}} */
  let failure = null;

  return {
    /** What is to be done with a frame: "show" it, "acknowledge" it, or "wait": it is being decoded already. */
    frame(seq) {
      if (seq <= painted || seq < received) return "acknowledge";
      if (seq === received) return "wait";
      received = seq;
      return "show";
    },
    /** Whether a newer frame came while this one was decoded. */
    isOvertaken: (seq) => seq < received,
    /** Take down that a frame is on the screen; a later one may be already. */
    paint(frame) {
      painted = Math.max(painted, frame.seq);
      if (frame.stale) return;
      good = Math.max(good, frame.seq);
      if (failure && failure.seq < good) failure = null;
    },
    /** Take down that a frame can't be shown; it may be sent again. */
    lose(seq) {
      if (received === seq) received = painted;
    },
    /** Whether an error says something new: neither a better frame nor a later error has come. An empty one ends it. */
    fail(error) {
      if (error.seq < good || (failure && error.seq < failure.seq)) return false;
      failure = error.text ? error : null;
      return true;
    },
    get failure() {
      return failure;
    },
    get painted() {
      return painted;
    },
  };
}

/** Lets through what is newest by its number; for messages that replace one another. */
export function newestOnly() {
  let newest = -Infinity;
  return (seq) => {
    if (seq < newest) return false;
    newest = seq;
    return true;
  };
}

/**
 * Asks one question at a time, the latest next.
 * @param {(question: any, id: number) => void} ask
 * @param {number} [patience_ms] after which an answer is taken for lost
 * @param {() => number} [now_ms]
 */
export function oneAtATime(ask, patience_ms = 1000, now_ms = () => performance.now()) {
  let id = 0;
  let asked_ms = -Infinity;
  let isOpen = false;
  let waiting = null;

  function send(question) {
    id += 1;
    isOpen = true;
    asked_ms = now_ms();
    waiting = null;
    ask(question, id);
  }

  return {
    ask(question) {
      if (isOpen && now_ms() - asked_ms < patience_ms) waiting = question;
      else send(question);
    },
    /** Whether this answers the last question; asks the one that waited. */
    answer(answered) {
      if (answered !== id) return false;
      isOpen = false;
      if (waiting) send(waiting);
      return true;
    },
    forget() {
      waiting = null;
    },
  };
}
