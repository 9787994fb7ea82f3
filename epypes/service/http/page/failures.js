// Which events failed, and how are they opened again?
import { ask, make, part } from "./server.js";

const MOST = 50;
const TEXT = 240;
const COPIED_MS = 1500;

/** @typedef {{id: string, event_id: string, function: string, exception: string, message: string, kind: string, attempt: number, dead_letter: boolean, when_ns: number, has_event: boolean}} Failure */

/** @type {Map<string, Failure>} */
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
  for (const id of ids.slice(MOST)) known.delete(id);
  const body = part("failures").tBodies[0];
  /** @type {Map<string, Element>} */
  const rows = new Map([...body.rows].map((row) => [row.dataset.id, row]));
  body.replaceChildren(...[...known.keys()].sort().reverse().map((id) => rows.get(id) ?? row(/** @type {Failure} */ (known.get(id)))));
  part("no-failures").hidden = known.size > 0;
  part("failures").parentElement.hidden = known.size === 0;
}

/** @param {Failure} failure */
function row(failure) {
  const when = new Date(failure.when_ns / 1e6);
  const what = `${failure.exception}: ${failure.message}`.replace(/\s+/g, " ");
  const kind = [failure.kind === "raised" ? "" : failure.kind, failure.dead_letter ? "dead letter" : "", failure.attempt > 1 ? `try ${failure.attempt}` : ""].filter(Boolean).join(", ");
  return make(
    "tr",
    { "data-id": failure.id },
    make("th", { scope: "row" }, make("a", { href: `v1/failures/${encodeURIComponent(failure.id)}` }, make("code", {}, failure.id))),
    make("td", {}, make("time", { datetime: when.toISOString(), title: when.toISOString() }, when.toLocaleString())),
    make("td", {}, make("code", {}, failure.function || "–")),
    make("td", { class: "message" }, kind ? `${kind} — ` : "", what.length > TEXT ? `${what.slice(0, TEXT)}…` : what),
    make("td", {}, copy(`epypes replay ${failure.id} ${location.origin}`, "Copy the command"), copy(`ep.load_failure("${failure.id}", "${location.origin}")`, "Copy the line of Python")),
  );
}

/** @param {string} line @param {string} label */
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
