"use strict";
(() => {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const narrow = matchMedia("(max-width: 40rem)");
  const touch = matchMedia("(pointer: coarse)");

  // Tables: a click on a heading sorts, numbers as numbers; rows without a value stay last.
  for (const table of document.querySelectorAll("table")) {
    const heads = [...table.tHead.rows[0].cells];
    heads.forEach((head, column) => {
      head.querySelector("button").addEventListener("click", () => {
        const up = head.getAttribute("aria-sort") !== "ascending";
        heads.forEach((other) => other.setAttribute("aria-sort", "none"));
        head.setAttribute("aria-sort", up ? "ascending" : "descending");
        const body = table.tBodies[0];
        const rows = [...body.rows].map((row) => [row, key(row.cells[column])]);
        rows.sort((a, b) => compare(a[1], b[1], up ? 1 : -1));
        body.append(...rows.map(([row]) => row));
      });
    });
  }

  // A table that is wider than the page says how many of its columns are out of sight.
  for (const box of document.querySelectorAll(".scroll")) {
    const note = document.createElement("p");
    note.className = "more";
    note.hidden = true;
    box.before(note);
    const say = () => {
      const right = box.getBoundingClientRect().right + 1;
      const out = [...box.querySelectorAll("thead th")]
        .filter((head) => head.getBoundingClientRect().right > right + 4).length;
      note.hidden = box.scrollWidth <= box.clientWidth;
      note.textContent = out ? `${out} more column${out > 1 ? "s" : ""} to the right \u2192` : "";
      if (out) box.dataset.more = out;
      else delete box.dataset.more;
    };
    box.addEventListener("scroll", say, { passive: true });
    new ResizeObserver(say).observe(box);
  }

  function key(cell) {
    if (cell.dataset.n !== undefined) return Number(cell.dataset.n);
    const text = cell.textContent.trim();
    return ["", "-", "–"].includes(text) ? null : text;
  }

  function compare(a, b, sign) {
    if (a === null || b === null) return (a === null) - (b === null);
    if (typeof a === "number" && typeof b === "number") return sign * (a - b);
    if (typeof a !== typeof b) return typeof a === "number" ? -1 : 1;
    return sign * a.localeCompare(b, undefined, { numeric: true });
  }

  // Figures: drawn one after another, so that the page answers meanwhile.
  const figures = [...document.querySelectorAll("figure.plot")].map((figure) => ({
    canvas: figure.querySelector(".canvas"),
    select: figure.querySelector("select"),
    plots: JSON.parse(figure.querySelector("script").textContent),
    drawn: false,
  }));

  function css(name) {
    return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  }

  // A long name in two lines, broken where it is best to.
  function shorter(name) {
    if (name.length <= 17) return name;
    const middle = name.length / 2;
    const breaks = [...name.matchAll(/[ ,:+_…-]/g)].map((match) => match.index + 1);
    breaks.sort((a, b) => Math.abs(a - middle) - Math.abs(b - middle));
    const place = breaks.find((k) => k < name.length && Math.abs(k - middle) < 9) ?? Math.round(middle);
    const cut = (part) => (part.length > 21 ? `${part.slice(0, 10)}…${part.slice(-10)}` : part);
    return `${cut(name.slice(0, place).trim())}<br>${cut(name.slice(place).trim())}`;
  }

  function themed(layout) {
    const text = css("--text"), grid = css("--grid"), line = css("--line");
    const small = narrow.matches;
    const found = {
      paper_bgcolor: "rgba(0,0,0,0)",
      plot_bgcolor: "rgba(0,0,0,0)",
      // The mode bar stands in the right margin, where it covers neither plot nor legend.
      margin: { l: small ? 44 : 60, r: touch.matches ? 10 : 40, t: 10, b: 46 },
      modebar: { orientation: "v", bgcolor: "rgba(0,0,0,0)", color: line, activecolor: text },
      hovermode: "closest",
      dragmode: touch.matches ? false : "zoom",
      ...layout,
      font: { color: text, size: small ? 12 : 13, family: getComputedStyle(document.body).fontFamily },
      hoverlabel: { bgcolor: css("--page"), bordercolor: line, font: { color: text }, namelength: -1 },
      legend: {
        orientation: "h", x: 0, y: 1, xanchor: "left", yanchor: "bottom",
        bgcolor: "rgba(0,0,0,0)", ...layout.legend,
      },
    };
    for (const name of Object.keys(found)) {
      if (/^[xy]axis\d*$/.test(name)) {
        found[name] = {
          gridcolor: grid, zerolinecolor: line, linecolor: line, tickcolor: line,
          fixedrange: touch.matches, ...found[name],
        };
        const names = found[name].categoryarray;
        if (small && names) {
          Object.assign(found[name], { tickmode: "array", tickvals: names, ticktext: names.map(shorter) });
        }
      }
    }
    return found;
  }

  function draw(item) {
    const plot = item.plots[item.select ? Number(item.select.value) : 0];
    item.drawn = true;
    const data = plot.data.map((trace) => {
      const bars = { color: css("--text"), thickness: 1.2, width: 3 };
      const found = { ...trace };
      for (const name of ["error_x", "error_y"]) {
        if (trace[name]) found[name] = { ...bars, ...trace[name] };
      }
      return found;
    });
    return Plotly.react(item.canvas, data, themed(plot.layout), {
      responsive: true,
      displaylogo: false,
      displayModeBar: touch.matches ? false : "hover",
      modeBarButtonsToRemove: ["lasso2d", "select2d", "autoScale2d"],
    });
  }

  function redraw() {
    figures.filter((item) => item.drawn).forEach(draw);
  }

  function drawNext(waiting) {
    const item = waiting.shift();
    if (item === undefined) {
      document.documentElement.dataset.ready = "yes";
      return;
    }
    if (!item.drawn) draw(item);
    setTimeout(drawNext, 0, waiting);
  }

  for (const item of figures) {
    if (item.select) item.select.addEventListener("change", () => draw(item));
  }
  dark.addEventListener("change", redraw);
  narrow.addEventListener("change", redraw);
  addEventListener("beforeprint", () => {
    figures.forEach(draw);
    document.querySelectorAll("details.meanings").forEach((part) => { part.open = true; });
  });
  addEventListener("afterprint", redraw);
  drawNext([...figures]);

  // Contents: closed on a narrow screen; the section in sight is marked.
  const contents = document.querySelector("nav details");
  if (contents) {
    if (!matchMedia("(min-width: 92rem)").matches) contents.open = false;
    const links = new Map(
      [...contents.querySelectorAll("a")].map((link) => [link.getAttribute("href").slice(1), link]),
    );
    const seen = new IntersectionObserver((entries) => {
      for (const entry of entries) {
        if (entry.isIntersecting) {
          links.forEach((link) => link.classList.remove("here"));
          links.get(entry.target.id).classList.add("here");
        }
      }
    }, { rootMargin: "-10% 0px -80% 0px" });
    document.querySelectorAll("main > section").forEach((section) => seen.observe(section));
  }
})();
