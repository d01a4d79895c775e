"use strict";
// The slider moves a cursor on the map and on every panel; so does a click on a track or panel.
(async () => {
  // Text of a script element, compressed as by `_packed` of page.py.
  const unpacked = async (id) => {
    const digits = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz!#$%&()*+-;,=>?@^_`{|}~";
    const value = Object.fromEntries([...digits].map((digit, k) => [digit, k]));
    const text = document.getElementById(id).textContent;
    const bytes = new DataView(new ArrayBuffer(4 * Math.ceil(text.length / 5)));
    for (let k = 0; k < text.length; k += 5) {
      let number = 0;
      for (let n = k; n < k + 5; n += 1) number = 85 * number + (n < text.length ? value[text[n]] : 84);
      bytes.setUint32((4 * k) / 5, number);
    }
    const missing = (5 - (text.length % 5)) % 5;
    const stream = new Blob([new Uint8Array(bytes.buffer, 0, bytes.byteLength - missing)]).stream();
    return new Response(stream.pipeThrough(new DecompressionStream("gzip"))).text();
  };
  if (!window.DecompressionStream) {
    document.getElementById("map").textContent = "This browser is too old to draw the report: it takes one of 2023 or later.";
    return;
  }
  document.head.append(Object.assign(document.createElement("script"), { textContent: await unpacked("plotly") }));
  const data = JSON.parse(await unpacked("data"));
  const [map, time] = ["map", "time"].map((id) => document.getElementById(id));
  const [slider, readout, play] = ["slider", "readout", "play"].map((id) => document.getElementById(id));
  const config = { responsive: true, displaylogo: false, scrollZoom: true,
    modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d", "sendChartToCloud"] };
  const cursors = data.cursors;
  const main = cursors[0];
  const [first, last] = [main.t[0], main.t[main.t.length - 1]];

  const axes = Object.keys(data.time.layout).filter((key) => /^yaxis\d*$/.test(key)).length;
  const line = (t) => Array.from({ length: axes }, (_, k) => ({
    type: "line", x0: t, x1: t, y0: 0, y1: 1, line: { color: "#222222", width: 1.5 },
    xref: k ? `x${k + 1}` : "x", yref: `y${k ? k + 1 : ""} domain` }));

  const nearest = (times, t) => {
    let [low, high] = [0, times.length - 1];
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (times[middle] <= t) low = middle; else high = middle;
    }
    return t - times[low] <= times[high] - t ? low : high;
  };
  const axis = (c, k) => {  // semi-axes of 1 sigma, larger first, and the direction of the larger
    const mean = 0.5 * (c.xx[k] + c.yy[k]);
    const off = Math.hypot(0.5 * (c.xx[k] - c.yy[k]), c.xy[k]);
    return [Math.sqrt(mean + off), Math.sqrt(Math.max(0, mean - off)), 0.5 * Math.atan2(2 * c.xy[k], c.xx[k] - c.yy[k])];
  };
  const hidden = new Set();
  // Shapes, since they can be redrawn without the traces.
  const outline = (c, k) => {
    const [a, b, turn] = axis(c, k);
    const corners = Array.from({ length: 48 }, (_, n) => {
      const [p, q] = [3 * a * Math.cos((n * Math.PI) / 24), 3 * b * Math.sin((n * Math.PI) / 24)];
      return `${c.x[k] + p * Math.cos(turn) - q * Math.sin(turn)},${c.y[k] + p * Math.sin(turn) + q * Math.cos(turn)}`;
    });
    return { type: "path", path: `M${corners.join("L")}Z`, fillcolor: c.colour + "33", line: { color: c.colour, width: 1.5 } };
  };
  const place = (c, k) => ({ type: "circle", name: c.name, xsizemode: "pixel", ysizemode: "pixel",
    xanchor: c.x[k], yanchor: c.y[k], x0: -7, x1: 7, y0: -7, y1: 7, fillcolor: c.colour, line: { color: "white", width: 2.5 } });
  const places = (t) => cursors.filter((c) => !hidden.has(c.name)).reverse().flatMap((c) => {
    const k = nearest(c.t, t);
    if (c.x[k] === null) return [];
    return c.xx ? [outline(c, k), place(c, k)] : [place(c, k)];
  });
  // A bar of 1, 2 or 5 times a power of ten metres, at most 120 px long.
  const scale = () => {
    const { _length, range } = map._fullLayout.xaxis;
    const perMetre = _length / (range[1] - range[0]);
    const power = 10 ** Math.floor(Math.log10(120 / perMetre));
    const metres = power * [5, 2, 1].find((n) => n * power * perMetre <= 120);
    Object.assign(document.getElementById("scale"), { textContent: `${+metres.toPrecision(1)} m` }).style.width = `${metres * perMetre}px`;
  };
  const number = (value, digits) => (value === null || value === undefined ? "-" : value.toFixed(digits));

  const wrapped = (deg) => (deg === null ? null : deg - 360 * Math.round(deg / 360));

  let [wanted, drawing] = [first, false];
  const draw = () => {
    drawing = false;
    const t = wanted;
    Plotly.relayout(map, { shapes: places(t) });
    Plotly.relayout(time, { shapes: line(t) });
    const k = nearest(main.t, t);
    const sigma = main.xx && main.x[k] !== null ? `, sigma ${number(axis(main, k)[0], 2)} m` : "";
    readout.textContent = `${number(t, 1)} s  |  ${main.label}: x ${number(main.x[k], 2)} m, y ${number(main.y[k], 2)} m` +
      `${sigma}, ${number(main.speed[k], 2)} m/s, yaw ${number(wrapped(main.yaw[k]), 0)} deg`;
    document.body.dataset.time = t.toFixed(3);
  };
  const show = (t) => {
    wanted = Math.min(last, Math.max(first, t));
    if (!drawing) { drawing = true; requestAnimationFrame(draw); }
  };
  const move = (t) => {
    slider.value = Math.round((1000 * (t - first)) / Math.max(1e-9, last - first));
    show(t);
  };

  let playing = null;
  const stop = () => { clearInterval(playing); playing = null; play.innerHTML = "&#9654;"; };
  play.addEventListener("click", () => {
    if (playing) { stop(); return; }
    if (wanted >= last) move(first);
    play.innerHTML = "&#10074;&#10074;";
    const step = Math.max(0.1, (last - first) / 200);  // the whole recording in twenty seconds
    playing = setInterval(() => { move(wanted + step); if (wanted >= last) stop(); }, 100);
  });
  slider.addEventListener("input", () => { stop(); show(first + (slider.value / 1000) * (last - first)); });

  for (const button of document.querySelectorAll("[data-track]")) {
    button.addEventListener("click", () => {
      const name = button.dataset.track;
      if (!hidden.delete(name)) hidden.add(name);
      button.setAttribute("aria-pressed", String(!hidden.has(name)));
      for (const figure of [map, time]) {
        const own = figure.data.flatMap((trace, k) => (trace.legendgroup === name ? [k] : []));
        if (own.length) Plotly.restyle(figure, { visible: !hidden.has(name) }, own);
      }
      show(wanted);
    });
  }

  const narrow = window.innerWidth <= 900;
  if (narrow) {
    data.time.layout.dragmode = false;  // a finger on a panel scrolls the page
    data.map.layout.margin.t = 8;  // no toolbar
    data.time.layout.height -= 24;
    data.time.layout.margin.t -= 24;
  }
  Promise.all([
    Plotly.newPlot(map, data.map.data, data.map.layout, { ...config, displayModeBar: !narrow }),
    Plotly.newPlot(time, data.time.data, data.time.layout, { ...config, scrollZoom: false, displayModeBar: !narrow }),
  ]).then(() => {
    time.on("plotly_click", (event) => { stop(); move(event.points[0].x); });
    map.on("plotly_click", (event) => {
      const at = event.points[0].customdata;
      if (at) { stop(); move(at[0]); }
    });
    map.on("plotly_relayout", scale);
    scale();
    move(first);
    document.body.dataset.ready = "yes";
  });
})();
