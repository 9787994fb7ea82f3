// The foot of the view: a line of code, named settings, promoting or writing back, and a log.
import { answer, element, iconButton, note, say, textButton } from "./elements.js";

const COPIED_MS = 1500;
const DIFF_LINES = [["---", "epypes-diff-file"], ["+++", "epypes-diff-file"], ["+", "epypes-added"], ["-", "epypes-removed"]];

const line = (...asking) => element("div", "epypes-foot-line epypes-with", {}, ...asking);

function settingsLine(panel, status) {
  const list = element("datalist", "", { id: `epypes-settings-${Math.random().toString(36).slice(2)}` });
  const name = element("input", "epypes-input epypes-setting", { type: "text", "aria-label": "Name of the settings", placeholder: "name of settings", list: list.id, spellcheck: "false" });
  const save = textButton("Save", () => onSetting("save"), "epypes-save", "Save the values as a TOML file");
  const load = textButton("Load", () => onSetting("load"), "epypes-load", "Load saved values");

  function onSetting(kind) {
    const asked = name.value.trim();
    if (asked) panel.send({ kind, name: asked });
    else answer(status, "Give the settings a name.", false);
  }

  name.addEventListener("keydown", (event) => event.key === "Enter" && onSetting("save"));
  return {
    line: line(list, name, save, load),
    offer: (names) => list.replaceChildren(...names.map((one) => element("option", "", { value: one }))),
    tell: (text, isGood) => answer(status, text, isGood),
  };
}

function promoteLine(panel, status) {
  const to = element("input", "epypes-input epypes-target", { type: "text", "aria-label": "Promote to", placeholder: "folder", spellcheck: "false" });
  const promote = textButton("Promote", onPromote, "epypes-promote", "Write the graph with these values as a folder of plain text, and check it");

  function onPromote() {
    promote.disabled = true;
    answer(status, "Promoting…");
    panel.send({ kind: "promote", to: to.value.trim() });
  }

  to.addEventListener("keydown", (event) => event.key === "Enter" && !promote.disabled && onPromote());
  return {
    line: line(to, promote),
    propose: (folder) => (to.value ||= folder),
    show({ state, text }) {
      promote.disabled = state === "running";
      answer(status, text || "Promoting…", state !== "refused");
    },
  };
}

/** In the place of promoting for a service: first what would change in its bundle, then the change. */
function writeBackLine(panel, status) {
  const ask = textButton("Write back", () => onAsk(true), "epypes-write-back", "Show what these values would change in pipeline.toml");
  const write = textButton("Write", () => onAsk(false), "epypes-write", "Write it, replay the samples, and seal the bundle anew");
  const cancel = textButton("Cancel", () => show({ state: "", text: "" }), "epypes-cancel");
  const diff = element("pre", "epypes-diff", { tabindex: "0", role: "region", "aria-label": "What changes in pipeline.toml", hidden: "" });
  const disable = (on) => [ask, write, cancel].forEach((button) => (button.disabled = on));

  function onAsk(isDry) {
    disable(true);
    panel.send({ kind: "write_back", dry_run: isDry });
  }

  function show({ state, text, diff: changes = "" }) {
    const isRunning = state === "running";
    disable(isRunning);
    ask.hidden = state === "diff" || (isRunning && !write.hidden);
    write.hidden = cancel.hidden = !ask.hidden;
    answer(status, text, state !== "refused");
    if (isRunning) return;
    diff.hidden = !changes;
    const kind = (one) => DIFF_LINES.find(([sign]) => one.startsWith(sign))?.[1];
    diff.replaceChildren(...changes.split("\n").map((one) => element("span", kind(one), {}, `${one}\n`)));
  }

  show({ state: "", text: "" });
  return { line: line(ask, write, cancel), diff, show };
}

export function footPart(panel) {
  const code = element("code", "epypes-code");
  const copied = element("span", "epypes-copied", { role: "status" });
  const copyButton = iconButton("copy", "Copy the line of code", onCopy, "epypes-copy");
  const status = element("div", "epypes-message epypes-outcome", { role: "status" });
  const settings = settingsLine(panel, status);
  const promoting = promoteLine(panel, status);
  const back = writeBackLine(panel, status);
  const [summary, lines] = [element("summary"), element("ol", "epypes-lines")];
  const log = element("details", "epypes-log", { hidden: "" }, summary, lines);
  const codeLine = element("div", "epypes-foot-line epypes-code-line", {}, code, copied, copyButton);

  async function onCopy() {
    try {
      await navigator.clipboard.writeText(code.textContent);
      say(copied, "copied");
    } catch {
      // Without leave for the clipboard the line is selected, for Ctrl+C.
      getSelection().selectAllChildren(code);
      say(copied, "selected");
    }
    setTimeout(() => say(copied, ""), COPIED_MS);
  }

  return {
    element: element("div", "epypes-foot", {}, codeLine, settings.line, promoting.line, back.line, status, back.diff, log),
    /** The lines that ask the kernel for something; the code can be copied and the log read without it. */
    asking: [settings.line, promoting.line, back.line],
    setup(message) {
      settings.offer(message.settings);
      promoting.propose(message.promote_to);
      promoting.line.hidden = message.writes_back;
      back.line.hidden = !message.writes_back;
    },
    history(message) {
      say(code, message.code);
      note(code, "title", message.code);
    },
    settings({ names, text, ok }) {
      settings.offer(names);
      settings.tell(text, ok);
    },
    promoted: promoting.show,
    written: back.show,
    log(message) {
      log.hidden = message.lines.length === 0;
      say(summary, `Log of the panel (${message.lines.length})`);
      lines.replaceChildren(...message.lines.map(({ at, text }) => element("li", "", {}, element("time", "", {}, at), ` ${text}`)));
    },
  };
}
