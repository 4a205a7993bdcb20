// Before the first paint: the theme that was chosen, else the system's, followed as it changes. A
// plain script, no module, so that nothing flashes.
(() => {
  const system = matchMedia("(prefers-color-scheme: dark)");
  const show = () => {
    let chosen = null;
    try {
      chosen = localStorage.getItem("relpos.theme");
    } catch {
      // Storage is forbidden: the system's theme it is.
    }
    const known = chosen === "light" || chosen === "dark";
    document.documentElement.dataset.theme = known ? chosen : system.matches ? "dark" : "light";
  };
  system.addEventListener("change", show);
  show();
})();
