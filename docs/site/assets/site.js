// What the theme leaves out for readers without a mouse: a name for the search, and wide tables that scroll by keyboard.
addEventListener("load", () => {
  document.querySelector(".md-search").setAttribute("aria-label", "Search");
  document.querySelectorAll(".md-typeset__scrollwrap").forEach((table) => table.setAttribute("tabindex", "0"));
});
