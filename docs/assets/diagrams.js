// Draws the pages' diagrams by the program that lies beside this file; where it is not, their text stays.
const texts = [...document.querySelectorAll("pre.diagram")];
if (texts.length) {
  const { mermaid } = await import("./mermaid/index.js");
  const dark = document.body.dataset.mdColorScheme === "slate";
  mermaid.initialize({ startOnLoad: false, theme: dark ? "dark" : "neutral" });
  for (const [number, text] of texts.entries()) {
    const { svg } = await mermaid.render(`diagram-${number}`, text.textContent);
    const drawn = document.createElement("div");
    drawn.className = "diagram";
    drawn.innerHTML = svg;
    text.replaceWith(drawn);
  }
}
