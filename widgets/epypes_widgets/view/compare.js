// How is the picture compared with another one: by flip, by wipe, or side by side?
import { decoded } from "./blobs.js";
import { element, follow, note, say } from "./elements.js";
import { wiped } from "./geometry.js";
import { same, shortly } from "./numbers.js";
import { drawOverlay } from "./overlay.js";
import { newestOnly } from "./protocol.js";

const KEY_SHARE = 0.02;

/** Return what a picture is compared with, in words. */
export function targetLabel(target) {
  if (!target) return "nothing";
  if (target.kind === "stage") return target.token;
  return target.kind === "history" ? `history #${shortly(target.number)}` : "default";
}

/** The second picture, and the ways of looking at it. */
export function comparePart(panel, stage) {
  const divider = element("div", "epypes-divider", {
    role: "slider",
    tabindex: "0",
    "aria-label": "Wipe between the two pictures",
    "aria-valuemin": "0",
    "aria-valuemax": "100",
    "aria-orientation": "horizontal",
    hidden: "",
  });
  const here = element("span", "epypes-which epypes-which-here", { hidden: "" });
  const there = element("span", "epypes-which epypes-which-there", { hidden: "" });
  stage.pane.append(divider, here);
  stage.box.append(there);
  let target = null;
  let mode = "";
  let isFlipped = false;
  let share = 0.5;
  let label = "";
  let isThere = false;
  const isNewest = newestOnly();
  const watchers = [];

  function clip() {
    if (mode !== "wipe" || isFlipped) {
      stage.layer.style.clipPath = "";
      return;
    }
    divider.style.left = `${share * stage.room.width}px`;
    note(divider, "aria-valuenow", String(Math.round(share * 100)));
    stage.layer.style.clipPath = `inset(0 0 0 ${wiped(share, stage.room, stage.place)}px)`;
  }

  function arrange() {
    const isSide = isThere && mode === "side";
    const home = isSide ? stage.secondCanvas : stage.canvas;
    if (stage.layer.parentElement !== home) {
      if (isSide) home.append(stage.layer);
      else stage.overlay.after(stage.layer);
    }
    stage.secondPane.hidden = !isSide;
    stage.box.classList.toggle("epypes-side", isSide);
    stage.box.classList.toggle("epypes-wiping", isThere && mode === "wipe");
    stage.box.classList.toggle("epypes-flipped", isThere && isFlipped);
    stage.layer.hidden = !isThere || (!isSide && mode !== "wipe" && !isFlipped);
    divider.hidden = !isThere || mode !== "wipe";
    here.hidden = there.hidden = !isThere || (!mode && !isFlipped);
    say(here, isFlipped && !isSide ? `B  ${label}` : "A  now");
    say(there, `B  ${label}`);
    there.hidden ||= isFlipped && !isSide;
    clip();
    for (const watcher of watchers) watcher();
  }

  function choose(next, wanted = mode) {
    if (!same(next, target)) {
      target = next;
      label = targetLabel(target);
      isThere = false;
      panel.send({ kind: "compare", with: target });
    }
    mode = target ? wanted : "";
    isFlipped &&= Boolean(target);
    if (!target) {
      stage.other.removeAttribute("src");
      panel.blobs.put(stage.other, "");
    }
    arrange();
  }

  const orDefault = () => target ?? { kind: "default" };

  follow(divider, () => ({
    move(event) {
      const at = stage.pane.getBoundingClientRect();
      share = Math.min(1, Math.max(0, (event.clientX - at.left) / at.width));
      clip();
    },
  }));
  divider.addEventListener("keydown", (event) => {
    const step = event.shiftKey ? 10 * KEY_SHARE : KEY_SHARE;
    const moves = { ArrowLeft: share - step, ArrowRight: share + step, Home: 0, End: 1 };
    if (!(event.key in moves)) return;
    event.preventDefault();
    event.stopPropagation();
    share = Math.min(1, Math.max(0, moves[event.key]));
    clip();
  });
  stage.watch(clip);

  return {
    choose: (next) => choose(next, mode || "wipe"),
    toggle: (wanted) => choose(orDefault(), mode === wanted ? "" : wanted),
    flip(on) {
      if (on === isFlipped) return;
      isFlipped = on;
      if (on && !target) choose(orDefault(), "");
      else arrange();
    },
    /** Show the bytes of the second picture; those of an older message don't replace newer ones. */
    async take(picture, bytes, seq, said = "") {
      const isStage = picture.role === "other" && !said;
      const isAsked = target && (isStage ? target.token === picture.token : target.kind !== "stage");
      if (!isAsked || !bytes || !isNewest(seq)) return;
      const asked = target;
      const url = panel.blobs.open(bytes, picture.media_type);
      const ready = await decoded(url);
      if (!ready || asked !== target || !isNewest(seq)) return panel.blobs.close(url);
      stage.other.src = url;
      panel.blobs.put(stage.other, url);
      drawOverlay(stage.otherMarks, picture.overlay);
      stage.other.alt = `${picture.token}, compared with: ${said || label}`;
      stage.other.dataset.seq = String(seq);
      isThere = true;
      label = said || label;
      arrange();
    },
    watch: (watcher) => watchers.push(watcher),
    get target() { return target; },
    get mode() { return mode; },
    get isFlipped() { return isFlipped; },
  };
}
