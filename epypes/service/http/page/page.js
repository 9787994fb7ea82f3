// The live page: its parts, and what is done from it.
import { loadFailures, sawFailure } from "./failures.js";
import { redraw, sawPlace, watchGraph } from "./graph.js";
import { sawParameters, showButtons, watchParameters } from "./parameters.js";
import { sawCounts, sawRun } from "./rates.js";
import { sawGroup } from "./replicas.js";
import { ask, confirmed, entries, hasKey, hear, keepKey, make, part, Refused, requireKey, say, takeKey } from "./server.js";

const TONES = { READY: "good", LOADING: "warn", PAUSED: "warn", DRAINING: "warn", DEGRADED: "error", FAULTED: "error", LOST: "error" };
/** The states in which each operation makes sense. */
const OPERATIONS = { pause: ["READY", "DEGRADED"], resume: ["PAUSED", "DRAINING"], drain: ["READY", "PAUSED", "DEGRADED"] };
const DIGITS = 12;

let state = "";

function sawState(now) {
  state = now.state;
  const badge = part("state");
  badge.textContent = now.state;
  badge.className = `badge ${TONES[now.state] ?? ""}`;
  part("reason").textContent = now.reason;
  showOperations();
  void loadInfo();
  redraw();
}

async function loadInfo() {
  const info = await ask("v1/info").catch(() => null);
  if (!info) return;
  part("name").textContent = info.name;
  document.title = `${info.name}: ${info.state}`;
  const facts = {
    replica: info.replica,
    bundle: info.bundle,
    digest: info.digest.slice(0, DIGITS),
    worker: info.worker_pid === null ? "none" : `process ${info.worker_pid}`,
    restarts: String(info.restarts),
    threads: String(info.threads),
    "events at": info.addresses.sub,
    "answers at": info.addresses.pub,
    "failures at": info.addresses.failures,
    ...Object.fromEntries(Object.entries(info.colours ?? {}).map(([token, text]) => [`colours of ${token}`, text])),
  };
  sawPlace(info.addresses.sub, info.counts.answered > 0);
  part("facts").replaceChildren(...entries(facts));
}

function showOperations() {
  const names = Object.keys(OPERATIONS);
  const wrong = names.filter((name) => !OPERATIONS[name].includes(state));
  for (const name of names) part(name).disabled = !hasKey() || wrong.includes(name);
  const labels = wrong.map((name) => part(name).textContent.replace("…", "")).join(", ");
  part("operation-why").textContent = !hasKey() ? "These need the access key." : wrong.length ? `${labels}: not while ${state || "connecting"}.` : "";
}

async function operate(path, body = undefined) {
  try {
    await ask(path, "POST", body);
    say("notice", "");
  } catch (error) {
    say("notice", error.message);
    if (error instanceof Refused && error.status === 403) refuseKey();
  }
}

async function drain() {
  const text = make("p", {}, "The service takes no more events until it is resumed, and works off those that wait.");
  if (await confirmed("Drain the service?", text, "Drain")) await operate("v1/drain", {});
}

function refuseKey() {
  keepKey("");
  showKey();
  say("notice", "This is not the service's access key. Open the link that epypes serve printed, or read the key in the file that it named.");
}

/** Take an access key only if it is that of the service. */
async function useKey(given) {
  keepKey(given);
  try {
    if (given) await requireKey();
    say("notice", "");
    showKey();
  } catch (error) {
    if (error instanceof Refused && [401, 403].includes(error.status)) return refuseKey();
    keepKey("");
    showKey();
    say("notice", error.message);
  }
}

function showKey() {
  const [form, isTaken] = [part("access-key-form"), hasKey()];
  part("access-key-hint").textContent = isTaken ? "The access key is right: changes are allowed in this tab." : "It is in the link that epypes serve printed, and in the file that it named. This tab keeps it until it is closed.";
  form.querySelector("button").textContent = isTaken ? "Forget the access key" : "Use";
  part("access-key").hidden = form.querySelector("label").hidden = isTaken;
  showOperations();
  showButtons();
}

function onHeard(isHeard) {
  say("notice", isHeard ? "" : "The service can't be reached; it is asked again. What is shown may be old.");
  if (isHeard) {
    void loadFailures().catch(() => undefined);
    redraw();
  } else {
    part("state").className = "badge";
    part("graph").classList.add("old");
  }
}

const takeGiven = () => {
  const given = takeKey();
  if (given) void useKey(given);
};
watchGraph();
watchParameters();
showKey();
takeGiven();
addEventListener("hashchange", takeGiven);
part("access-key-form").addEventListener("submit", (event) => {
  event.preventDefault();
  const given = hasKey() ? "" : part("access-key").value;
  part("access-key").value = "";
  void useKey(given);
});
part("pause").addEventListener("click", () => void operate("v1/pause"));
part("resume").addEventListener("click", () => void operate("v1/resume"));
part("drain").addEventListener("click", () => void drain());
const redrawn = (saw) => (data) => {
  saw(data);
  redraw();
};
hear(
  {
    state: sawState,
    counts: sawCounts,
    group: (group) => sawGroup(group, TONES),
    parameters: redrawn(sawParameters),
    run: redrawn(sawRun),
    failure: redrawn(sawFailure),
  },
  onHeard,
);
