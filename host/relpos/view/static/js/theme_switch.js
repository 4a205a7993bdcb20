// The switch between light (sunlight) and dark.

import { setAttribute, setText, storage } from "./dom.js";
import { t } from "./i18n.js";

/** Which theme is shown; theme.js has set it. */
export function isDark() {
  return document.documentElement.dataset.theme === "dark";
}

/** Make `button` switch; `changed` is called after every change, the system's too. */
export function themeSwitch(button, changed) {
  const store = storage();
  const show = () => {
    const next = isDark() ? "light" : "dark";
    setText(button.querySelector(".word"), t(`theme.${next}`));
    setAttribute(button, "aria-label", t(`theme.${next}.label`));
    changed();
  };
  button.addEventListener("click", () => {
    const theme = isDark() ? "light" : "dark";
    document.documentElement.dataset.theme = theme;
    store.setItem("relpos.theme", theme);
    show();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", show);
  show();
  return show;
}
