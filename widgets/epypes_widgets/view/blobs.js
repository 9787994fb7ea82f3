// Who holds the bytes of a picture, and until when?

/**
 * The object URLs of a view: one per place, revoked when another takes it, and all at the end.
 */
export function blobs() {
  /** @type {Map<unknown, string>} */
  const held = new Map();

  /** Make a URL that belongs to nobody yet. */
  const open = (buffer, type) => URL.createObjectURL(new Blob(buffer ? [buffer] : [], { type }));
  const close = (url) => URL.revokeObjectURL(url);

  /** Give a place a URL, and end the one that it had. */
  function put(place, url) {
    const old = held.get(place);
    if (url) held.set(place, url);
    else held.delete(place);
    if (old && old !== url) close(old);
  }

  return {
    open,
    close,
    put,
    /** Show bytes in an image whose moment does not matter; nothing for no bytes. */
    fill(img, buffer, type = "image/jpeg") {
      const url = buffer && buffer.byteLength ? open(buffer, type) : "";
      if (url) img.src = url;
      else img.removeAttribute("src");
      put(img, url);
    },
    /** Forget places that are shown no longer. */
    drop(places) {
      for (const place of places) put(place, "");
    },
    closeAll() {
      for (const url of held.values()) close(url);
      held.clear();
    },
    get size() {
      return held.size;
    },
  };
}

/** Return a picture decoded off the screen; null if the bytes are none. */
export async function decoded(url) {
  const made = new Image();
  made.src = url;
  try {
    await made.decode();
    return made;
  } catch {
    return null;
  }
}
