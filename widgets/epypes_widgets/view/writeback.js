// How are values written back into the bundle of a service: first what would change, then the change?
import { element, say, textButton } from "./elements.js";

const REMOVED = "-";
const ADDED = "+";

/** The line of the foot that takes the place of promoting, and the differences below it. */
export function writeBackPart(panel) {
  const ask = textButton("Write back", () => onAsk(true), "epypes-write-back", "Show what these values would change in pipeline.toml");
  const write = textButton("Write", () => onAsk(false), "epypes-write", "Write it, replay the samples, and seal the bundle anew");
  const cancel = textButton("Cancel", () => show("", ""), "epypes-cancel");
  const outcome = element("span", "epypes-outcome", { role: "status" });
  const diff = element("pre", "epypes-diff", { tabindex: "0", role: "region", "aria-label": "What changes in pipeline.toml", hidden: "" });
  const line = element("div", "epypes-foot-line", { hidden: "" }, element("span", "epypes-with", {}, ask, write, cancel), outcome);

  function onAsk(isDry) {
    ask.disabled = write.disabled = cancel.disabled = true;
    panel.send({ kind: "write_back", dry_run: isDry });
  }

  function kind(text) {
    if (text.startsWith("---") || text.startsWith("+++")) return "epypes-diff-file";
    if (text.startsWith(ADDED)) return "epypes-added";
    return text.startsWith(REMOVED) ? "epypes-removed" : "";
  }

  function show(state, text, changes = "") {
    const isRunning = state === "running";
    ask.disabled = write.disabled = cancel.disabled = isRunning;
    const isAsked = state === "diff" || (isRunning && !write.hidden);
    write.hidden = cancel.hidden = !isAsked;
    ask.hidden = isAsked;
    say(outcome, state === "refused" ? `! ${text}` : text);
    outcome.title = text;
    outcome.classList.toggle("epypes-refused", state === "refused");
    if (isRunning) return;
    diff.hidden = !changes;
    diff.replaceChildren(...changes.split("\n").map((one) => element("span", kind(one), {}, `${one}\n`)));
  }

  show("", "");
  return {
    line,
    diff,
    setup: (message) => {
      line.hidden = !message.writes_back;
    },
    written: (message) => show(message.state, message.text, message.diff ?? ""),
  };
}
