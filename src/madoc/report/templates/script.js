/* Charts, the choice of a run, and films; words and tables need none of it. */
(async () => {
  const all = (selector, within = document) => [...within.querySelectorAll(selector)];
  const charts = all("[data-figure]");
  const figures = new Map(charts.map((chart) => [chart, JSON.parse(chart.dataset.figure)]));
  const touch = matchMedia("(pointer: coarse)").matches;

  const unpack = async (text) => {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    const script = document.createElement("script");
    script.textContent = await new Response(stream).text();
    document.head.append(script);
  };
  const painted = (value, style) => {
    if (typeof value === "string") return value.replace(/var\((--\w+)\)/, (_, name) => style.getPropertyValue(name).trim());
    if (Array.isArray(value)) return value.map((part) => painted(part, style));
    if (value === null || typeof value !== "object") return value; /* a number, or none */
    return Object.fromEntries(Object.entries(value).map(([key, part]) => [key, painted(part, style)]));
  };
  const draw = (chart) => {
    const style = getComputedStyle(document.documentElement);
    const { data, layout } = figures.get(chart);
    const axis = { gridcolor: "var(--rule)", linecolor: "var(--faint)", zeroline: false, automargin: true };
    const base = {
      margin: { l: 48, r: 8, t: 8, b: 38 },
      font: { family: style.getPropertyValue("--sans"), size: 12, color: "var(--muted)" },
      paper_bgcolor: "rgba(0,0,0,0)",
      plot_bgcolor: "rgba(0,0,0,0)",
      showlegend: false,
      dragmode: touch ? false : "zoom",
      hoversubplots: "axis",
      modebar: { bgcolor: "rgba(0,0,0,0)", color: "var(--faint)", activecolor: "var(--ink)" },
      hoverlabel: { bgcolor: "var(--card)", bordercolor: "var(--rule)", font: { color: "var(--ink)" } },
      ...layout,
    };
    for (const name of new Set(["xaxis", "yaxis", ...Object.keys(layout).filter((key) => /^[xy]axis/.test(key))]))
      base[name] = { ...axis, ...layout[name] };
    const buttons = [["zoom2d", "pan2d", "resetScale2d", "toImage"]];
    const config = { responsive: true, displaylogo: false, displayModeBar: touch ? false : "hover", modeBarButtons: buttons };
    Plotly.react(chart, painted(data, style), painted(base, style), config);
  };

  /* The run that is shown: the others' lines are hidden, and axes fit this one. */
  for (const choice of all("select[data-runs]"))
    choice.addEventListener("change", () => {
      for (const chart of all("[data-figure]", choice.closest("section"))) {
        const { data, layout } = figures.get(chart);
        data.forEach((line) => (line.visible = line.meta === choice.selectedIndex));
        for (const [name, ranges] of Object.entries(layout.meta)) layout[name].range = ranges[choice.selectedIndex];
        if (chart.data) draw(chart);
      }
    });

  for (const film of all("[data-film]")) {
    const { time, columns, still } = JSON.parse(film.dataset.film);
    const sheets = all(".sheet", film), [play, slider, told] = all("button, input, output", film);
    const rows = Math.ceil(time.length / columns);
    let playing = 0, begun = false;
    const show = (index) => {
      const across = (100 * (index % columns)) / (columns - 1);
      const down = (100 * Math.floor(index / columns)) / Math.max(1, rows - 1);
      for (const sheet of sheets) sheet.style.backgroundPosition = `${across}% ${down}%`;
      slider.value = index;
      told.textContent = `${time[index].toFixed(2)} s`;
    };
    const stop = () => {
      cancelAnimationFrame(playing);
      playing = 0;
      play.textContent = "Play";
    };
    play.addEventListener("click", () => {
      if (playing) return stop();
      const last = time.length - 1, first = begun && Number(slider.value) < last ? Number(slider.value) : 0;
      begun = true;
      const began = performance.now();
      const next = (now) => {
        const at = time[first] + (now - began) / 1000;
        let index = first;
        while (index < last && time[index + 1] <= at) index += 1;
        show(index);
        if (index < last) playing = requestAnimationFrame(next);
        else stop();
      };
      playing = requestAnimationFrame(next);
      play.textContent = "Pause";
    });
    slider.addEventListener("input", () => {
      stop();
      begun = true;
      show(Number(slider.value));
    });
    show(still);
  }

  if (!charts.length) return;
  await unpack(document.getElementById("plotly").textContent);
  /* From the top, whenever the browser is idle: the page can be read meanwhile. */
  const idle = window.requestIdleCallback ?? ((next) => setTimeout(next, 50));
  const left = [...charts];
  const rest = () => {
    const next = left.shift();
    if (!next) return;
    idle(rest); /* before the drawing: a chart that fails leaves the others */
    if (!next.data) draw(next);
  };
  idle(rest);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => charts.filter((chart) => chart.data).forEach(draw));
  addEventListener("beforeprint", () => charts.filter((chart) => !chart.data).forEach(draw));
})();
