// Floor maps: every place a square, every heading a slice of it, as geometry.py lays them out; the maps of success.

// Where a scene's states are drawn, see geometry.py; `next` unpacked.
function drawing(scene) {
  const plan = DATA.scenes[scene];
  return { ...plan, next: unpack(plan.next) };
}

// What is drawn of a room: its plan's walls and furniture, or the steps that are blocked, see geometry.py.
function ground(plan) {
  const box = ([x, y, width, height], kind, name) => {
    const drawn = svg("rect", { class: kind, x, y, width: Math.max(width, 0.06), height: Math.max(height, 0.06), ...(kind === "thing" ? { rx: 0.06 } : {}) });
    if (name) drawn.append(svg("title", {}, name));
    return drawn;
  };
  const edges = (plan.edges || []).map(([x0, y0, x1, y1]) => `M${x0} ${y0}L${x1} ${y1}`).join("");
  if (!plan.room) return { floor: [], walls: edges ? [svg("path", { class: "edge", d: edges })] : [] };
  const of = (...kinds) => plan.things.filter((thing) => kinds.includes(thing.kind));
  return {
    floor: [box(plan.room, "floor-rect"), ...of("rug").map((thing) => box(thing.rect, "rug", thing.name)), ...of("furniture").map((thing) => box(thing.rect, "thing", thing.name))],
    walls: [...plan.solids.map((rect) => box(rect, "solid")), box(plan.room, "outer"), ...of("door", "window").map((thing) => box(thing.rect, thing.kind, thing.name))],
  };
}

// A round length that fits into half of the map, with its words.
function rulerOf(plan, width) {
  if (plan.metre === null) return null;
  const lengths = [[10, "10 m"], [5, "5 m"], [2, "2 m"], [1, "1 m"], [0.5, "50 cm"], [0.2, "20 cm"], [0.1, "10 cm"], [0.01, "1 cm"]];
  const wanted = width > 24 * plan.metre ? 2 : 1; // metres
  return lengths.find(([metres]) => metres <= wanted && metres * plan.metre <= 0.5 * width) || lengths.at(-1);
}

const MARGIN = 0.55; // squares around the places, so that a dart at the edge is whole

function floorMap(host, scene, label, small = false) {
  const plan = DATA.scenes[scene], { paths } = plan;
  let [left, top, right, bottom] = [-MARGIN, -MARGIN, plan.width + MARGIN, plan.height + MARGIN];
  if (plan.room) {
    const [x, y, width, height] = plan.room;
    [left, top, right, bottom] = [Math.min(left, x - 0.2), Math.min(top, y - 0.2), Math.max(right, x + width + 0.2), Math.max(bottom, y + height + 0.2)];
  }
  const width = right - left, most = small ? 34 : 64; // pixels of a square, at most
  const scale = Math.min(most, (small ? Math.min(300, innerWidth / 2 - 40) : Math.min(700, innerWidth - 70)) / width), letter = (small ? 10 : 12) / scale;
  const slices = paths.map((d, i) => svg("path", { class: "s", "data-i": i, d }));
  const length = rulerOf(plan, width), under = bottom + letter * 0.4;
  const ruler = length === null ? [] : [
    svg("path", { class: "ruler", "stroke-width": letter * 0.12, d: `M${left + 0.1} ${under}v${letter * 0.5}h${length[0] * plan.metre}v-${letter * 0.5}` }),
    svg("text", { class: "ruler-text", "font-size": letter, x: left + 0.1 + length[0] * plan.metre + letter * 0.5, y: under + letter * 0.75 }, length[1]),
  ];
  const { floor, walls } = ground(plan);
  const groups = ["arrows", "trail", "marks"].map((name) => svg("g", { class: name }));
  const drawn = svg(
    "svg", { viewBox: `${left} ${top} ${width} ${bottom - top + (length === null ? 0 : letter * 1.6)}`, role: "img", "aria-label": label },
    svg("g", { class: "ground" }, ...floor), svg("g", { class: "slices" }, ...slices), svg("g", { class: "walls" }, ...walls), ...groups, ...ruler,
  );
  drawn.style.maxWidth = `${Math.round(width * most)}px`;
  host.replaceChildren(drawn);
  const layer = (name) => host.querySelector(`.${name}`);
  return {
    scale,
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
    caption.replaceChildren(make("b", {}, row.scene), ` · ${seen.length ? `mean ${percent(mean)}` : "not measured"}`);
  }
}

function startMaps() {
  const grid = $("map-grid");
  const labels = [...new Set(DATA.maps.map((row) => row.model))];
  const names = [...new Set(DATA.maps.flatMap((row) => Object.keys(row).filter(isShare)))];
  const order = DATA.metrics.map((metric) => metric.name).filter((name) => names.includes(name));
  fill($("map-measure"), order.map((name) => [name, titleOf(name)]), DATA.hardest);
  $("maps").hidden = !DATA.maps.length;
  $("map-opens").hidden = !DATA.agents.length;
  grid.classList.toggle("opens", DATA.agents.length > 0);
  const plans = Object.values(DATA.scenes);
  $("map-ground").textContent = plans.some((plan) => plan.room) ? "Walls and furniture are those of the plan that a room was rendered from." : plans.some((plan) => plan.edges?.length) ? "Dark lines mark steps that are blocked." : "";
  for (const label of labels) {
    const rows = DATA.maps.filter((row) => row.model === label);
    const cells = make("div", { class: "map-cells" });
    const of = rows[0].seeds ? `${rows[0].episodes} episodes per goal, from ${rows[0].seeds} seed${rows[0].seeds > 1 ? "s" : ""}` : "computed exactly, from every start";
    grid.append(make("div", { class: "map-row" }, make("h3", {}, label, make("span", {}, of)), cells));
    for (const row of rows) {
      const caption = make("figcaption");
      const floor = make("div", { class: "floor" });
      cells.append(make("figure", {}, caption, floor));
      const map = floorMap(floor, row.scene, `${label}: success of every goal in ${row.scene}`, true);
      const { middles } = DATA.scenes[row.scene];
      const size = Math.max(0.16, 3.2 / map.scale);
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
        (state) => { if (DATA.agents.length) openGoal(label, row.scene, state); },
      );
      successMaps.push({ map, row, caption });
    }
  }
  $("map-measure").addEventListener("change", paintSuccess);
  redraws.push(paintSuccess);
}
