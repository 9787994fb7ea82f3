// The picture compared with another one: by flip, by wipe, or side by side.
import { consume, element, follow, note, say } from "./elements.js";
import { clear, swap } from "./frames.js";
import { same } from "./numbers.js";
import { drawOverlay } from "./overlay.js";
import { newestOnly } from "./protocol.js";

const KEY_SHARE = 0.02;

/** Return what a picture is compared with, in words. */
export function targetLabel(target) {
  if (!target) return "nothing";
  if (target.kind === "stage") return target.token;
  return target.kind === "history" ? `history #${target.number}` : "default";
}

/** The second picture, and the ways of looking at it. */
export function comparePart(panel, stage) {
  const divider = element("div", "epypes-divider", {
    role: "slider", tabindex: "0", "aria-label": "Wipe between the two pictures", "aria-valuemin": "0", "aria-valuemax": "100", hidden: "",
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

  function wipe(next = share) {
    share = Math.min(1, Math.max(0, next));
    const covered = share * stage.room.width - stage.place.x;
    stage.layer.style.clipPath = mode === "wipe" && !isFlipped ? `inset(0 0 0 ${covered}px)` : "";
    divider.style.left = `${share * stage.room.width}px`;
    note(divider, "aria-valuenow", Math.round(share * 100));
  }

  function arrange() {
    const isSide = isThere && mode === "side";
    const isCovered = isFlipped && !isSide;
    const home = isSide ? stage.secondCanvas : stage.canvas;
    if (stage.layer.parentElement !== home) home.insertBefore(stage.layer, isSide ? null : stage.roi);
    stage.secondPane.hidden = !isSide;
    stage.layer.hidden = !isThere || (!mode && !isFlipped);
    divider.hidden = !isThere || mode !== "wipe";
    here.hidden = stage.layer.hidden;
    there.hidden = here.hidden || isCovered;
    say(here, isCovered ? `B  ${label}` : "A  now");
    say(there, `B  ${label}`);
    wipe();
    panel.refresh();
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
    if (!target) clear(stage.other);
    arrange();
  }

  const orDefault = () => target ?? { kind: "default" };

  follow(divider, () => ({
    move(event) {
      const at = stage.pane.getBoundingClientRect();
      wipe((event.clientX - at.left) / at.width);
    },
  }));
  divider.addEventListener("keydown", (event) => {
    const step = event.shiftKey ? 10 * KEY_SHARE : KEY_SHARE;
    const next = { ArrowLeft: share - step, ArrowRight: share + step, Home: 0, End: 1 }[event.key];
    if (next === undefined) return;
    consume(event);
    wipe(next);
  });
  stage.watch(wipe);

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
    async take(picture, bytes, seq, reference = "") {
      const isAsked = target && (reference ? target.kind !== "stage" : target.token === picture.token);
      if (!isAsked || !bytes || !isNewest(seq)) return;
      const asked = target;
      if (!(await swap(stage.other, bytes, picture.media_type))) return;
      if (asked !== target) return choose(target);
      drawOverlay(stage.otherMarks, picture.overlay);
      panel.dress(stage.other, picture, stage.otherUnder.hasAttribute("src") && picture.token === panel.state.token);
      stage.other.alt = `${picture.token}, compared with: ${reference || label}`;
      stage.other.dataset.seq = String(seq);
      isThere = true;
      label = reference || label;
      arrange();
    },
    get target() { return target; },
    get mode() { return mode; },
    get isFlipped() { return isFlipped; },
  };
}
