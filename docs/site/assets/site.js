// What the theme leaves out for readers without a mouse: a name for the search, and wide tables that scroll by keyboard.
addEventListener("load", () => {
  document.querySelector(".md-search").setAttribute("aria-label", "Search");
  // A word that begins with a hyphen means "without it" to the search; a reader means an option, such as --toml.
  const query = document.querySelector("input.md-search__input");
  query.addEventListener("input", () => {
    const words = query.value.replace(/(^|\s)-+(?=\w)/g, "$1");
    if (words !== query.value) query.value = words;
  }, true);
  document.querySelectorAll(".md-typeset__scrollwrap").forEach((table) => table.setAttribute("tabindex", "0"));
});
