// Before the first paint: the theme that was chosen, else the system's. A plain script, no module,
// so that nothing flashes.
(() => {
  let chosen = null;
  try {
    chosen = localStorage.getItem("relpos.theme");
  } catch {
    // Storage is forbidden: the system's theme it is.
  }
  if (chosen === "light" || chosen === "dark") document.documentElement.dataset.theme = chosen;
})();
