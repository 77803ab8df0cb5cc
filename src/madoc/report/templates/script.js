/* Values under the pointer; the page is whole without it. */
(() => {
  const box = document.createElement("div");
  box.className = "told";
  box.hidden = true;
  document.body.append(box);
  const words = (value) => {
    if (value === null) return "–";
    const size = Math.abs(value);
    const text = size && (size < 1e-3 || size >= 1e6) ? value.toExponential(2) : String(value);
    return text.replace(/-/g, "−");
  };
  const row = (colour, name, value) => {
    const line = document.createElement("div");
    const swatch = document.createElement("i");
    const number = document.createElement("b");
    line.className = colour;
    number.textContent = value;
    line.append(swatch, name, number);
    return line;
  };
  for (const chart of document.querySelectorAll("svg[data-values]")) {
    const drawn = JSON.parse(chart.dataset.values);
    const pointer = chart.querySelector(".pointer");
    const hide = () => {
      box.hidden = true;
      pointer.style.visibility = "hidden";
    };
    chart.addEventListener("pointerleave", hide);
    chart.addEventListener("pointermove", (event) => {
      const frame = chart.getBoundingClientRect();
      const across = ((event.clientX - frame.left) / frame.width) * chart.viewBox.baseVal.width;
      let nearest = 0;
      drawn.at.forEach((at, index) => {
        if (Math.abs(at - across) < Math.abs(drawn.at[nearest] - across)) nearest = index;
      });
      pointer.setAttribute("x1", drawn.at[nearest]);
      pointer.setAttribute("x2", drawn.at[nearest]);
      pointer.style.visibility = "visible";
      const head = document.createElement("small");
      head.textContent = `${drawn.title}: ${words(drawn.x[nearest])}`;
      box.replaceChildren(head, ...drawn.lines.map(([name, colour, y]) => row(colour, name, words(y[nearest]))));
      box.hidden = false;
      const left = Math.min(event.clientX + 14, innerWidth - box.offsetWidth - 8);
      box.style.left = `${Math.max(8, left)}px`;
      box.style.top = `${Math.max(8, event.clientY - box.offsetHeight - 14)}px`;
    });
  }
})();
