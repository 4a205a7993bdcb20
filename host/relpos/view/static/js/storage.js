// What a browser keeps.

/** localStorage where it may be used; private windows and file permissions can forbid it. */
export function storage() {
  try {
    localStorage.setItem("relpos.probe", "1");
    localStorage.removeItem("relpos.probe");
    return localStorage;
  } catch {
    const kept = new Map();
    return {
      lasting: false,
      getItem: (key) => kept.get(key) ?? null,
      setItem: (key, value) => kept.set(key, String(value)),
      removeItem: (key) => kept.delete(key),
    };
  }
}
