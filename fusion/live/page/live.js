"use strict";
// Draws the data of /events: a track per device on the map; sigma, speed and yaw over time.
(() => {
  const element = (id) => document.getElementById(id);
  const [map, time, connection] = [element("map"), element("time"), element("connection")];
  // Neighbours differ in lightness too; lines end in their device's symbol.
  const COLOURS = ["#0072B2", "#E69F00", "#000000", "#CC79A7", "#009E73", "#56B4E9", "#D55E00", "#7F5539"];
  const SYMBOLS = ["circle", "square", "diamond", "triangle-up"];
  const BESIDE = ["top center", "bottom center", "middle right", "middle left"];
  const MOST_DRAWN = 1200;
  const MOST_KEPT = 24000;
  const devices = new Map();
  window.stario = { devices };

  // All devices share one map frame. Points are [t, x, y, z, speed, yaw, xx, xy, yy, sigma of yaw, x, y of the line].
  const plain = (text) => text.replaceAll("&", "&amp;").replaceAll("<", "&lt;");  // plotly reads HTML
  const several = (n, one) => `${n} ${one}${n === 1 ? "" : one.endsWith("x") ? "es" : "s"}`;
  const sigmaOf = (p) => Math.sqrt((p[6] + p[8]) / 2 + Math.hypot((p[6] - p[8]) / 2, p[7]));
  const thinned = (points) => {
    const step = Math.ceil(points.length / MOST_DRAWN);
    return step < 2 ? points : points.filter((_, k) => k % step === 0 || k === points.length - 1);
  };
  const ellipse = (p, origin) => {
    const [mean, off] = [(p[6] + p[8]) / 2, Math.hypot((p[6] - p[8]) / 2, p[7])];
    const [a, b] = [3 * Math.sqrt(mean + off), 3 * Math.sqrt(Math.max(0, mean - off))];
    const turn = 0.5 * Math.atan2(2 * p[7], p[6] - p[8]);
    const corners = Array.from({ length: 40 }, (_, k) => {
      const [u, v] = [a * Math.cos((k * Math.PI) / 20), b * Math.sin((k * Math.PI) / 20)];
      return `${p[1] - origin[0] + u * Math.cos(turn) - v * Math.sin(turn)},${p[2] - origin[1] + u * Math.sin(turn) + v * Math.cos(turn)}`;
    });
    return `M${corners.join("L")}Z`;
  };

  const axis = (title) => ({ title: { text: title, standoff: 4, font: { size: 13 } }, gridcolor: "#E3E6EA", zeroline: false,
    linecolor: "#767676", showline: true, ticks: "outside", ticklen: 4, tickcolor: "#767676" });
  const font = { family: "system-ui, sans-serif", size: 13, color: "#222222" };
  const base = { font, paper_bgcolor: "white", plot_bgcolor: "white", showlegend: false };
  const fitted = { autorange: true, autorangeoptions: { include: [-3, 3] } };  // until the map is moved
  const mapLayout = { ...base, margin: { l: 54, r: 10, t: 6, b: 42 }, dragmode: "pan", hovermode: "closest", uirevision: 1,
    xaxis: { ...axis("x [m]"), ...fitted }, yaxis: { ...axis("y [m]"), ...fitted, scaleanchor: "x" } };
  const rows = [["Position sigma [m]", sigmaOf], ["Speed [m/s]", (p) => p[4]], ["Yaw [deg]", (p) => p[5]]];
  const timeLayout = { ...base, height: 460, margin: { l: 54, r: 10, t: 22, b: 42 }, hovermode: "x", dragmode: false, uirevision: 1,
    grid: { rows: 3, columns: 1, pattern: "independent", ygap: 0.38 },
    annotations: rows.map(([text], k) => ({ text, x: 0, xanchor: "left", xref: "paper", yref: `y${k ? k + 1 : ""} domain`,
      y: 1.02, yanchor: "bottom", showarrow: false, font })) };
  rows.forEach((_, k) => {
    timeLayout[`xaxis${k ? k + 1 : ""}`] = { ...axis(k === 2 ? "time since the start of each track [s]" : ""), ...(k ? { matches: "x" } : {}) };
    timeLayout[`yaxis${k ? k + 1 : ""}`] = { ...axis(""), ...(k === 2 ? { range: [-185, 185], dtick: 90 } : { rangemode: "tozero" }) };
  });
  const config = { responsive: true, displaylogo: false, displayModeBar: false, scrollZoom: true };

  const draw = async () => {
    const [mapTraces, timeTraces, shapes] = [[], [], []];
    for (const d of devices.values()) {
      const points = thinned(d.points);
      const line = { color: d.colour, width: 2 };
      const place = (p) => [p[1] - d.origin[0], p[2] - d.origin[1]];
      const words = (p) => `<b>${plain(d.label)}</b> at ${p[0].toFixed(1)} s<br>sigma ${sigmaOf(p).toFixed(2)} m<br>speed ${p[4].toFixed(2)} m/s`;
      const last = points[points.length - 1];
      const way = [...points.map((p) => [p[10] - d.origin[0], p[11] - d.origin[1]]), ...(last ? [place(last)] : [])];
      mapTraces.push({ x: d.places.map((p) => p[1] - d.origin[0]), y: d.places.map((p) => p[2] - d.origin[1]), mode: "markers",
        marker: { color: d.colour, size: 5, opacity: 0.45 }, hovertemplate: "%{text}<extra></extra>",
        text: d.places.map((p) => `<b>${plain(d.label)}</b>, satellites at ${p[0].toFixed(0)} s${p[3] ? `<br>radius ${p[3].toFixed(0)} m` : ""}`) });
      mapTraces.push({ x: way.map((xy) => xy[0]), y: way.map((xy) => xy[1]), mode: "lines", line, text: points.map(words), hovertemplate: "%{text}<extra></extra>" });
      mapTraces.push({ x: last ? [place(last)[0]] : [], y: last ? [place(last)[1]] : [], mode: "markers+text", text: [plain(d.label)],
        textposition: d.beside, cliponaxis: false, hoverinfo: "skip", marker: { color: d.colour, symbol: d.symbol, size: 13, line: { color: "white", width: 2 } } });
      if (last) shapes.push({ type: "path", path: ellipse(last, d.origin), line: { color: d.colour, width: 1 }, fillcolor: d.colour + "22" });
      rows.forEach(([, value], k) => {
        let before = null;
        const ys = points.map((p) => {
          const y = value(p);
          const jumps = k === 2 && before !== null && Math.abs(y - before) > 180;  // yaw passes 180 degrees
          before = y;
          return jumps ? null : y;
        });
        const marker = { color: d.colour, symbol: d.symbol, size: points.map((_, n) => n === points.length - 1 ? 9 : 0), opacity: 1 };
        timeTraces.push({ x: points.map((p) => p[0]), y: ys, mode: "lines+markers", line, marker, xaxis: `x${k ? k + 1 : ""}`,
          yaxis: `y${k ? k + 1 : ""}`, hovertemplate: `${plain(d.label)} %{y:.2f}<extra></extra>` });
      });
    }
    mapLayout.shapes = shapes;
    const onEarth = [...devices.values()].some((d) => d.georeferenced);
    mapLayout.xaxis.title.text = onEarth ? "east [m]" : "x [m]";
    mapLayout.yaxis.title.text = onEarth ? "north [m]" : "y [m]";
    element("dots").hidden = ![...devices.values()].some((d) => d.places.length);
    await Plotly.react(map, mapTraces, mapLayout, config);
    if (onEarth && map.dataset.tiles) askBackground();
    time.parentElement.hidden = !shapes.length;  // no empty plots
    if (shapes.length) await Plotly.react(time, timeTraces, timeLayout, config);
  };

  // The tiles reach beyond the limits for which they were asked; others are asked where the map is moved or zoomed out of them.
  let [background, asking] = [null, false];
  const askBackground = async () => {
    const [[left, right], [bottom, top]] = [map._fullLayout.xaxis.range, map._fullLayout.yaxis.range];
    const span = Math.max(right - left, top - bottom);
    const [x, y] = [(left + right) / 2, (bottom + top) / 2];
    const seen = background && Math.hypot(x - background.x, y - background.y) < background.span / 4;
    if (asking || (seen && span < 1.4 * background.span && span > 0.4 * background.span)) return;
    asking = true;
    try {
      const answer = await fetch(`background?${new URLSearchParams({ left, right, bottom, top })}`);
      mapLayout.images = await answer.json();
      mapLayout.annotations = [{ text: `map: ${map.dataset.tiles}`, xref: "paper", yref: "paper", x: 1, y: 0, showarrow: false,
        bgcolor: "rgba(255,255,255,0.8)", font: { size: 11 } }];
      background = { x, y, span };
      redraw();
    } catch {}  // the next message asks again
    asking = false;
  };

  // A slow browser draws less often: it spends at most half of its time drawing.
  let [drawing, wanted] = [false, false];
  const redraw = async () => {
    wanted = true;
    if (drawing) return;
    drawing = true;
    while (wanted) {
      wanted = false;
      const began = performance.now();
      await draw();
      await new Promise((done) => setTimeout(done, Math.max(150, performance.now() - began)));
    }
    drawing = false;
  };

  const post = async (id, command, content = {}) => {
    let error = "";
    try {
      const answer = await fetch("command", { method: "POST", headers: { "content-type": "application/json" },
        body: JSON.stringify({ device: id, command, ...content }) });
      const found = answer.ok ? {} : await answer.json().catch(() => ({}));
      error = answer.ok ? "" : found.error || `the server answers with status ${answer.status}`;
    } catch {
      error = "no connection to the server";
    }
    const shown = devices.get(id)?.card.querySelector(".error");
    if (shown) Object.assign(shown, { textContent: error, hidden: !error });
  };

  let tapping = null;
  const tap = (id) => {
    tapping = id;
    element("tap").hidden = id === null;
    if (id !== null) {
      element("tap-text").textContent = `Tap the map where ${devices.get(id).label} is now`;
      element("tap").scrollIntoView();  // beside many phones the map may be out of sight
    }
  };
  element("tap-cancel").addEventListener("click", () => tap(null));
  element("fit").addEventListener("click", () => Plotly.relayout(map, { "xaxis.autorange": true, "yaxis.autorange": true }));
  const watchMap = () => {
    let pressed = null;
    map.addEventListener("pointerdown", (event) => { pressed = [event.clientX, event.clientY]; }, true);
    // Of a mouse, plotly's cover over the page gets it.
    document.addEventListener("pointerup", (event) => {
      const moved = pressed && Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > 6;
      const tapped = pressed && !moved;
      pressed = null;
      if (tapping === null || !tapped) return;
      const layout = map._fullLayout;
      const box = map.getBoundingClientRect();
      const x = layout.xaxis.p2d(event.clientX - box.left - layout.xaxis._offset);
      const y = layout.yaxis.p2d(event.clientY - box.top - layout.yaxis._offset);
      post(tapping, "fix", { x, y, sigma: Number(element("sigma").value) });
      tap(null);
    }, true);
    map.on("plotly_relayout", redraw);  // perhaps with other tiles
  };

  const button = (text, title, act) => {
    const made = document.createElement("button");
    Object.assign(made, { type: "button", textContent: text, title });
    made.addEventListener("click", act);
    return made;
  };
  const newDevice = (id) => {
    const used = new Set([...devices.values()].map((device) => device.n));
    const n = [...Array(used.size + 1).keys()].find((k) => !used.has(k));
    const card = document.createElement("article");
    card.className = "device";
    card.dataset.device = id;
    card.innerHTML = '<h2><svg width="20" height="20" aria-hidden="true"></svg><span class="name"></span><span class="state"></span></h2>' +
      '<div class="figures"></div><ul class="words"></ul><div class="tools"></div><p class="error" hidden></p><p class="file"></p>';
    const device = { id, n, label: id.length > 24 ? `${id.slice(0, 22)}..` : id, colour: COLOURS[n % COLOURS.length],
      symbol: SYMBOLS[n % SYMBOLS.length], beside: BESIDE[n % BESIDE.length],
      points: [], places: [], origin: [0, 0, 0], received: 0, running: true, card };
    const corners = { circle: "", square: "4,4 16,4 16,16 4,16", diamond: "10,2 18,10 10,18 2,10", "triangle-up": "10,3 18,17 2,17" }[device.symbol];
    card.querySelector("svg").innerHTML = (corners ? `<polygon points="${corners}"` : '<circle cx="10" cy="10" r="7"') + ` fill="${device.colour}"/>`;
    card.querySelector(".name").textContent = id;
    device.toggle = button("Stop", "End this track, or start a new one", () => post(id, device.running ? "stop" : "start"));
    device.zero = button("Zero here", "Show the current position as x = y = 0", () => post(id, "zero"));
    device.fix = button("Place on map", "Give the filter the current position by a tap on the map", () => tap(id));
    card.querySelector(".tools").append(device.toggle, device.zero, device.fix);
    element("devices").append(card);
    devices.set(id, device);
    return device;
  };

  const show = (device, now) => {
    const p = device.points[device.points.length - 1];
    const age = now - device.received;
    const state = device.card.querySelector(".state");
    const silent = device.running && age > 3;
    state.textContent = !device.running ? "stopped" : silent ? `no data for ${age.toFixed(0)} s` : `live, ${device.rate.toFixed(0)} Hz`;
    state.classList.toggle("bad", silent);
    const figures = p ? [
      [`${Math.hypot(p[1] - device.origin[0], p[2] - device.origin[1]).toFixed(1)} m`, "from the origin"],
      [`${sigmaOf(p).toFixed(2)} m`, "position sigma"],
      [`${p[4].toFixed(2)} m/s`, "speed"],
      [`${p[5].toFixed(0)} ± ${p[9].toFixed(0)}°`, "yaw, 1 sigma"],
      [`${(Math.round(10 * (p[3] - device.origin[2])) / 10 || 0).toFixed(1)} m`, ["height", device.floor].filter(Boolean).join(", ")],
      [`${Math.floor(p[0] / 60)}:${String(Math.floor(p[0] % 60)).padStart(2, "0")}`, "time (min:s)"]] : [];
    device.card.querySelector(".figures").replaceChildren(...figures.map(([value, what]) => {
      const box = document.createElement("div");
      box.append(Object.assign(document.createElement("b"), { textContent: value }),
        Object.assign(document.createElement("span"), { textContent: what }));
      return box;
    }));
    const words = [...(device.problem ? [{ level: "warning", text: device.problem, advice: "" }] : []), ...device.health];
    const key = JSON.stringify(words);
    if (key !== device.words) {
      device.words = key;
      device.card.querySelector(".words").replaceChildren(...words.map((word) => {
        const item = Object.assign(document.createElement("li"), { className: word.level, textContent: word.text });
        if (word.advice) item.append(Object.assign(document.createElement("em"), { textContent: word.advice }));
        return item;
      }));
    }
    device.toggle.textContent = device.running ? "Stop" : "Start a new track";
    device.zero.disabled = device.fix.disabled = !p || !device.running;
    device.zero.hidden = device.georeferenced;
    const dropped = Object.entries(device.dropped).map(([reason, n]) => `${n} ${reason}`).join(", ");
    device.card.querySelector(".file").textContent = [`${device.file ? `${device.file}: ` : ""}${several(device.samples, "sample")}`,
      dropped && `dropped: ${dropped}`, device.fixes && several(device.fixes, "fix"), device.satellites].filter(Boolean).join(", ");
  };

  const remove = (id) => {
    if (tapping === id) tap(null);
    devices.get(id).card.remove();
    devices.delete(id);
  };

  let waiting = true;
  const take = (message) => {
    const known = new Set(message.devices.map((news) => news.id));
    [...devices.keys()].filter((id) => !known.has(id)).forEach(remove);  // the server made room for others
    for (const news of message.devices) {
      const device = devices.get(news.id) || newDevice(news.id);
      const { id, fresh, points, ...status } = news;
      Object.assign(device, status);
      device.points = fresh ? points : device.points.concat(points);
      if (device.points.length > MOST_KEPT) device.points = device.points.filter((_, k) => k % 2 === 0);
      show(device, message.time);
    }
    if (!devices.size !== waiting) element("add").open = waiting = !devices.size;
    connection.textContent = several(devices.size, "device") + (message.refused ? `, ${several(message.refused, "message")} rejected` : "");
    connection.className = "";
    redraw();
  };

  draw().then(() => {
    watchMap();
    const events = new EventSource("events" + location.search);
    events.onmessage = (event) => { take(JSON.parse(event.data)); document.body.dataset.ready = "yes"; };
    events.onerror = () => { connection.textContent = "no connection to the server, retrying"; connection.className = "bad"; };
  });
})();
