// Floor maps: every place a square, every heading a slice of it, as geometry.py lays them out; the maps of success.

// Where a scene's states are drawn, see geometry.py; `next` unpacked.
function drawing(scene) {
  const plan = DATA.scenes[scene];
  return { ...plan, next: unpack(plan.next) };
}

function floorMap(host, scene, label, small = false) {
  const { paths, width, height, metre } = DATA.scenes[scene];
  const letter = small ? width * 0.055 : Math.max(0.35, width * 0.026); // a letter's height
  const slices = paths.map((d, i) => svg("path", { class: "s", "data-i": i, d }));
  const ruler = metre === null ? [] : [
    svg("path", { class: "ruler", "stroke-width": letter * 0.12, d: `M0.1 ${height + 0.35}v${letter * 0.5}h${metre}v-${letter * 0.5}` }),
    svg("text", { class: "ruler-text", "font-size": letter, x: 0.1 + metre + letter * 0.5, y: height + 0.35 + letter * 0.7 }, "1 m"),
  ];
  const groups = ["arrows", "trail", "marks"].map((name) => svg("g", { class: name }));
  host.replaceChildren(svg(
    "svg", { viewBox: `-0.1 -0.1 ${width + 0.2} ${height + 0.5 + letter}`, role: "img", "aria-label": label },
    svg("g", { class: "slices" }, ...slices), ...groups, ...ruler,
  ));
  const layer = (name) => host.querySelector(`.${name}`);
  return {
    paint: (colour) => slices.forEach((path, i) => { const found = colour(i); path.style.fill = found === "none" ? "var(--wall)" : found; }),
    layer,
    // what(state, event) when the pointer is over a state, chosen(state) when it is pressed
    listen: (what, chosen) => {
      host.addEventListener("pointermove", (event) => (event.target.dataset.i === undefined ? hush() : what(Number(event.target.dataset.i), event)));
      host.addEventListener("pointerleave", hush);
      host.addEventListener("click", (event) => { if (event.target.dataset.i !== undefined) chosen(Number(event.target.dataset.i), event); });
    },
  };
}

function tipOf(scene, state, ...lines) {
  const content = [];
  const url = picture(scene, state);
  if (url) content.push(make("img", { src: url, alt: "" }));
  for (const line of lines) content.push(make("div", {}, line));
  return content;
}

// ---- the maps of success

const successMaps = [];

function paintSuccess() {
  const name = $("map-measure").value;
  drawScale($("map-scale"), VIRIDIS, "0", "100", "%");
  $("map-unknown").hidden = !successMaps.some(({ row }) => row[name] && unpack(row[name]).some(Number.isNaN));
  for (const { map, row, caption } of successMaps) {
    const values = row[name] ? unpack(row[name]) : [];
    map.paint((state) => ramp(VIRIDIS, values[state]));
    const seen = Array.from(values).filter(Number.isFinite);
    const mean = seen.length ? seen.reduce((sum, value) => sum + value, 0) / seen.length : NaN;
    caption.replaceChildren(make("b", {}, words(row.scene)), ` · ${seen.length ? `mean ${percent(mean)}` : "not measured"}`);
  }
}

function startMaps() {
  const grid = $("map-grid");
  const labels = [...new Set(DATA.maps.map((row) => row.model))];
  const names = [...new Set(DATA.maps.flatMap((row) => Object.keys(row).filter(isShare)))];
  const order = DATA.metrics.map((metric) => metric.name).filter((name) => names.includes(name));
  fill($("map-measure"), order.map((name) => [name, titleOf(name)]), DATA.hardest);
  $("maps").hidden = !DATA.maps.length;
  for (const label of labels) {
    const rows = DATA.maps.filter((row) => row.model === label);
    const cells = make("div", { class: "map-cells" });
    const of = rows[0].seeds ? `${rows[0].episodes} episodes per goal, from ${rows[0].seeds} seed${rows[0].seeds > 1 ? "s" : ""}` : "computed exactly, from every start";
    grid.append(make("div", { class: "map-row" }, make("h3", {}, label, make("span", {}, of)), cells));
    for (const row of rows) {
      const caption = make("figcaption");
      const floor = make("div", { class: "floor" });
      cells.append(make("figure", {}, caption, floor));
      const map = floorMap(floor, row.scene, `${label}: success of every goal in ${words(row.scene)}`, true);
      const { middles, width } = DATA.scenes[row.scene];
      const size = Math.max(0.16, width * 0.011);
      map.layer("marks").replaceChildren(...row.trained.map(
        (goal) => svg("circle", { class: "trained", cx: middles[goal][0], cy: middles[goal][1], r: size, "stroke-width": size * 0.45 }),
      ));
      map.listen(
        (state, event) => {
          const name = $("map-measure").value;
          const value = row[name] ? unpack(row[name])[state] : NaN;
          const kind = row.trained.includes(state) ? ", trained" : "";
          tell(event, ...tipOf(row.scene, state, `goal ${state}${kind}: ${percent(value)}`));
        },
        (state, event) => openGoal(label, row.scene, state, event),
      );
      successMaps.push({ map, row, caption });
    }
  }
  $("map-measure").addEventListener("change", paintSuccess);
  redraws.push(paintSuccess);
}
