// The table of the events that failed, and how each is opened again.
import { ask, confirmed, entries, make, part, say } from "./server.js";

const MOST = 50;
const TEXT = 240;
const COPIED_MS = 1500;

/** @typedef {{id: string, event_id: string, function: string, exception: string, message: string, kind: string, attempt: number, dead_letter: boolean, when_ns: number, has_event: boolean}} Failure */

/** @type {Map<string, Failure>} by id */
const known = new Map();

/** Read the failures that are kept. */
export async function loadFailures() {
  const { failures } = await ask(`v1/failures?limit=${MOST}`);
  for (const failure of failures) known.set(failure.id, failure);
  show();
}

/** @param {Failure} failure */
export function sawFailure(failure) {
  known.set(failure.id, failure);
  show();
}

function show() {
  // Ids rise with time.
  const ids = [...known.keys()].sort().reverse();
  for (const id of ids.splice(MOST)) known.delete(id);
  const body = part("failures").tBodies[0];
  const rows = new Map([...body.rows].map((row) => [row.dataset.id, row]));
  body.replaceChildren(...ids.map((id) => rows.get(id) ?? row(known.get(id))));
  part("no-failures").hidden = known.size > 0;
  part("failures").parentElement.hidden = known.size === 0;
}

const address = (id) => `v1/failures/${encodeURIComponent(id)}`;

/** Show what is known of a failure, with its traceback. */
async function open(id) {
  try {
    const record = await ask(address(id));
    await confirmed(`${record.exception || record.kind} in ${record.function || "the worker"}`, described(record));
  } catch (error) {
    say("notice", error.message);
  }
}

function described(record) {
  const facts = {
    When: new Date(record.when_ns / 1e6).toLocaleString(),
    "Reads and makes": record.tokens.join(", "),
    Event: record.event_id,
    Kind: [record.kind, `try ${record.attempt}`, record.dead_letter ? "dead letter" : ""].filter(Boolean).join(", "),
    Parameters: Object.entries(record.hyperparameters).map(([token, entry]) => `${token} = ${JSON.stringify(entry.value ?? null)}`).join(", "),
    Revision: String(record.revision),
    "Its frame": record.has_event ? "was kept" : "was not kept",
  };
  const trace = record.trace.map((line) => line.replace(/\n$/, "")).join("\n");
  return make(
    "div",
    {},
    make("p", { class: "message" }, record.message),
    make("dl", { class: "record" }, ...entries(facts)),
    trace ? make("pre", { tabindex: "0", "aria-label": "Traceback" }, trace) : make("p", { class: "quiet" }, "There is no traceback."),
    make("p", {}, make("a", { href: address(record.id) }, "The record as JSON")),
  );
}

function opener(id) {
  const link = make("a", { href: address(id), title: "Show the record and its traceback" }, make("code", {}, id));
  link.addEventListener("click", (event) => {
    event.preventDefault();
    void open(id);
  });
  return link;
}

function row(failure) {
  const when = new Date(failure.when_ns / 1e6);
  const what = `${failure.exception}: ${failure.message}`.replace(/\s+/g, " ");
  const kind = [failure.kind === "raised" ? "" : failure.kind, failure.dead_letter ? "dead letter" : "", failure.attempt > 1 ? `try ${failure.attempt}` : ""].filter(Boolean).join(", ");
  return make(
    "tr",
    { "data-id": failure.id },
    make("th", { scope: "row" }, opener(failure.id)),
    make("td", {}, make("time", { datetime: when.toISOString(), title: when.toISOString() }, when.toLocaleString())),
    make("td", {}, make("code", {}, failure.function || "–")),
    make("td", { class: "message" }, kind ? `${kind} — ` : "", what.length > TEXT ? `${what.slice(0, TEXT)}…` : what),
    make("td", {}, copy(`epypes replay ${failure.id} ${location.origin}`, "Copy the command"), copy(`ep.load_failure("${failure.id}", "${location.origin}")`, "Copy the line of Python")),
  );
}

function copy(line, label) {
  const button = make("button", { type: "button", class: "small", "aria-label": label, title: label }, "Copy");
  const code = make("code", {}, line);
  button.addEventListener("click", async () => {
    try {
      await navigator.clipboard.writeText(line);
      button.textContent = "Copied";
    } catch {
      // Not every page may write to the clipboard: what is selected can be copied by hand.
      getSelection()?.selectAllChildren(code);
      button.textContent = "Selected";
    }
    setTimeout(() => (button.textContent = "Copy"), COPIED_MS);
  });
  return make("div", { class: "copy" }, button, code);
}
