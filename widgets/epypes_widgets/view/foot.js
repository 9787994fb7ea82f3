// What is kept of the values: a line of code, named settings, a promoted graph, and a log of the panel?
import { element, iconButton, note, say, textButton } from "./elements.js";
import { writeBackPart } from "./writeback.js";

const COPIED_MS = 1500;

/** Copies without the page's permission where the browser has no clipboard for it. */
async function copy(text) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    const area = element("textarea", "", { style: "position:fixed;opacity:0" });
    area.value = text;
    document.body.append(area);
    area.select();
    const isDone = document.execCommand("copy");
    area.remove();
    return isDone;
  }
}

export function footPart(panel) {
  const code = element("code", "epypes-code");
  const copied = element("span", "epypes-copied", { role: "status" });
  const copyButton = iconButton("copy", "Copy the line of code", onCopy, "epypes-copy");
  const list = element("datalist", "", { id: `epypes-settings-${Math.random().toString(36).slice(2)}` });
  const name = element("input", "epypes-input epypes-setting", { type: "text", "aria-label": "Name of the settings", placeholder: "name of settings", list: list.id, spellcheck: "false" });
  const save = textButton("Save", () => onSetting("save"), "epypes-save", "Save the values as a TOML file");
  const load = textButton("Load", () => onSetting("load"), "epypes-load", "Load saved values");
  const said = element("span", "epypes-said epypes-setting-said", { role: "status" });
  const to = element("input", "epypes-input epypes-target", { type: "text", "aria-label": "Promote to", placeholder: "folder", spellcheck: "false" });
  const promote = textButton("Promote", onPromote, "epypes-promote", "Write the graph with these values as a folder of plain text, and check it");
  const outcome = element("span", "epypes-outcome", { role: "status" });
  const promoting = element("div", "epypes-foot-line", {}, element("span", "epypes-with", {}, to, promote), outcome);
  const settings = element("div", "epypes-foot-line", {}, element("span", "epypes-with", {}, list, name, save, load), said);
  const back = writeBackPart(panel);
  const lines = element("ol", "epypes-lines");
  const summary = element("summary", "");
  const log = element("details", "epypes-log", { hidden: "" }, summary, lines);
  const root = element(
    "div",
    "epypes-foot",
    {},
    element("div", "epypes-foot-line epypes-code-line", {}, code, copied, copyButton),
    settings,
    promoting,
    back.line,
    back.diff,
    log,
  );

  async function onCopy() {
    say(copied, (await copy(code.textContent)) ? "copied" : "not copied");
    setTimeout(() => say(copied, ""), COPIED_MS);
  }

  function onSetting(kind) {
    const asked = name.value.trim();
    if (asked) panel.send({ kind, name: asked });
    else tell(said, "Give the settings a name.", false);
  }

  function onPromote() {
    promote.disabled = true;
    tell(outcome, "Promoting…", true);
    panel.send({ kind: "promote", to: to.value.trim() });
  }

  function tell(node, text, isGood) {
    say(node, text && !isGood ? `! ${text}` : text);
    node.title = text;
    node.classList.toggle("epypes-refused", !isGood);
  }

  function offer(names) {
    const key = names.join("\n");
    if (list.dataset.key === key) return;
    list.dataset.key = key;
    list.replaceChildren(...names.map((one) => element("option", "", { value: one })));
  }

  name.addEventListener("keydown", (event) => event.key === "Enter" && onSetting("save"));
  to.addEventListener("keydown", (event) => event.key === "Enter" && !promote.disabled && onPromote());

  const tellCode = (text) => {
    say(code, text ?? "");
    note(code, "title", text ?? "");
  };

  return {
    element: root,
    /** The lines that ask the kernel for something; the code can be copied and the log read without it. */
    asking: [settings, promoting, back.line],
    setup(message) {
      tellCode(message.code);
      offer(message.settings ?? []);
      if (!to.value) to.value = message.promote_to ?? "";
      promoting.hidden = Boolean(message.writes_back);
      back.setup(message);
    },
    history: (message) => message.code !== undefined && tellCode(message.code),
    settings(message) {
      offer(message.names ?? []);
      tell(said, message.text ?? "", message.ok);
    },
    promoted(message) {
      const isRunning = message.state === "running";
      promote.disabled = isRunning;
      tell(outcome, isRunning ? message.text || "Promoting…" : message.text, message.state !== "refused");
    },
    written: back.written,
    log(message) {
      log.hidden = message.lines.length === 0;
      say(summary, `Log of the panel (${message.lines.length})`);
      lines.replaceChildren(...message.lines.map((line) => element("li", "", {}, element("time", "", {}, line.at), ` ${line.text}`)));
    },
  };
}
