"use strict";
// Copies commands and SQL, and marks the section that is read in the table of contents.
(() => {
  async function copy(button) {
    const source = button.closest(".code").querySelector("pre");
    const status = button.parentElement.querySelector("[role=status]");
    try {
      await navigator.clipboard.writeText(source.textContent);
      status.textContent = " Copied.";
    } catch {
      getSelection().selectAllChildren(source);
      status.textContent = " Copy the selected text.";
    }
  }
  document.querySelectorAll(".copy").forEach((button) => button.addEventListener("click", () => copy(button)));

  const links = new Map([...document.querySelectorAll("nav a")].map((link) => [link.hash.slice(1), link]));
  const visible = new Set();
  const observer = new IntersectionObserver((entries) => {
    for (const entry of entries) visible[entry.isIntersecting ? "add" : "delete"](entry.target.id);
    const first = [...links.keys()].find((name) => visible.has(name));
    for (const [name, link] of links) {
      if (name === first) link.setAttribute("aria-current", "true");
      else link.removeAttribute("aria-current");
    }
  }, { rootMargin: "-10% 0px -60% 0px" });
  for (const name of links.keys()) {
    const target = document.getElementById(name);
    if (target) observer.observe(target);
  }
})();
