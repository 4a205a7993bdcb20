// The switch between light (sunlight) and dark.

import { setAttribute, setText, storage } from "./dom.js";

const system = matchMedia("(prefers-color-scheme: dark)");

export function isDark() {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === "dark" : system.matches;
}

/** Make `button` switch; `changed` is called after every change, the system's too. */
export function themeSwitch(button, changed) {
  const kept = storage();
  const show = () => {
    const next = isDark() ? "Light" : "Dark";
    setText(button.querySelector(".word"), next);
    setAttribute(button, "aria-label", `${next} theme`);
    changed();
  };
  button.addEventListener("click", () => {
    const theme = isDark() ? "light" : "dark";
    document.documentElement.dataset.theme = theme;
    kept.setItem("relpos.theme", theme);
    show();
  });
  system.addEventListener("change", show);
  show();
}
