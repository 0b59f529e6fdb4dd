// The charts of Plotly: overview, distance, learning curves; and the tables.

const CONFIG = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"] };

function layout(more) {
  const ink = css("--ink"), muted = css("--muted"), line = css("--line");
  const axis = { gridcolor: line, zerolinecolor: line, linecolor: line, tickfont: { color: muted }, automargin: true };
  const base = {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", autosize: true,
    font: { family: getComputedStyle(document.body).fontFamily, size: 13, color: ink },
    margin: { l: 56, r: 18, t: 16, b: 48 }, hoverlabel: { bgcolor: css("--panel"), bordercolor: line, font: { color: ink } },
    legend: { orientation: "h", x: 0, y: 1.02, yanchor: "bottom", font: { color: ink } }, modebar: { bgcolor: "rgba(0,0,0,0)", color: muted, activecolor: ink },
  };
  const merged = { ...base, ...more };
  for (const name of ["xaxis", "yaxis"]) {
    const { title, ...rest } = more[name] || {};
    merged[name] = { ...axis, ...rest, title: { text: title || "", font: { color: muted, size: 13 }, standoff: 10 } };
  }
  return merged;
}

// Plotly fills its host, which must be as high as the chart; on a narrow screen the legend is above it, one line per model.
function plot(id, traces, wanted) {
  const named = traces.filter((trace) => trace.name && trace.showlegend !== false).length;
  const height = wanted.height + (narrow() ? 21 * named : 0);
  $(id).style.height = `${height + (narrow() ? 6 : 14)}px`;
  Plotly.react(id, traces, layout({ ...wanted, height }), CONFIG);
}

const narrow = () => innerWidth < 600;

const scaled = (name, value) => (known(value) ? (isShare(name) ? 100 * value : value) : null);

function rowsOf(table) {
  const [goals, scene] = [$("subset").value, $("scene").value];
  return DATA.tables[table].filter((row) => row.goals === goals && row.scene === scene);
}

// Words above the dashed lines: those that would overlap go to rows of their own.
function labels(lines, range, models) {
  const letter = 6.6, left = 20 + 8 * Math.max(0, ...models.map((name) => name.length)); // pixels; the axis takes as much
  const width = Math.max(120, $("overview").clientWidth - left - 36);
  const ends = [], notes = [];
  for (const [text, x] of [...lines].sort((a, b) => a[1] - b[1])) {
    const at = ((x - range[0]) / (range[1] - range[0])) * width, long = letter * text.length;
    const xanchor = at + long / 2 > width ? "right" : at < long / 2 ? "left" : "center";
    const begin = at - { right: long, left: 0, center: long / 2 }[xanchor];
    let row = ends.findIndex((end) => begin > end + 8);
    if (row < 0) row = ends.length;
    ends[row] = begin + long;
    notes.push({ text, x, xanchor, yshift: 15 * row, xref: "x", y: 1, yref: "paper", yanchor: "bottom", showarrow: false, font: { color: css("--muted"), size: 12 } });
  }
  return { notes, rows: ends.length };
}

function drawOverview() {
  const name = $("measure").value;
  const summary = rowsOf("summary");
  const models = summary.filter((row) => row.kind === "model");
  const shown = models.map((row) => plain(row.model));
  const traces = models.map((row) => {
    const colour = colourOf(row.model);
    const [mean, low, high] = [row[name], row[`${name}_from`], row[`${name}_to`]].map((value) => scaled(name, value));
    return {
      type: "scatter", mode: "markers", x: [mean], y: [plain(row.model)], showlegend: false,
      marker: { color: colour, size: 15, symbol: SYMBOLS[place(row.model) % 8], line: { color: css("--panel"), width: 1.5 } },
      error_x: { type: "data", symmetric: false, array: [Math.max(0, high - mean)], arrayminus: [known(low) ? Math.max(0, mean - low) : 0], color: colour, thickness: 2.5, width: 0 },
      hovertemplate: `<b>${plain(row.model)}</b><br>mean of ${row.seeds} seed${row.seeds > 1 ? "s" : ""}: %{x:.1f}<br>95 % interval ${low?.toFixed(1)} to ${high?.toFixed(1)}<extra></extra>`,
    };
  });
  const seeds = rowsOf("seeds").filter((row) => known(row[name]));
  traces.unshift({
    type: "scatter", mode: "markers", showlegend: false, x: seeds.map((row) => scaled(name, row[name])), y: seeds.map((row) => plain(row.model)),
    marker: { size: 7, color: seeds.map((row) => faded(colourOf(row.model), 0.55)) },
    text: seeds.map((row) => `${plain(row.model)}, seed ${row.seed}`), hovertemplate: "%{text}: %{x:.1f}<extra></extra>",
  });
  const beside = summary.filter((row) => row.kind === "reference" && known(row[name]));
  const lines = beside.map((row) => ({
    type: "line", xref: "x", yref: "paper", x0: scaled(name, row[name]), x1: scaled(name, row[name]), y0: 0, y1: 1,
    line: { color: css("--muted"), width: 1.4, dash: "dash" },
  }));
  const values = [...traces.flatMap((trace) => trace.x), ...beside.map((row) => scaled(name, row[name]))].filter(known);
  const most = Math.max(...values, 0), range = isShare(name) ? [0, 102] : [0, 1.06 * most];
  const { notes, rows } = labels(beside.map((row) => [plain(row.model), scaled(name, row[name])]), range, shown);
  plot("overview", traces, {
    height: 90 + 16 * rows + 46 * Math.max(2, shown.length), shapes: lines, annotations: notes, margin: { l: 20, r: 24, t: 14 + 16 * rows, b: 50 },
    xaxis: { title: narrow() ? headOf(name) : titleOf(name), range, ticksuffix: isShare(name) ? " %" : "" },
    yaxis: { type: "category", categoryorder: "array", categoryarray: [...shown].reverse(), range: [-0.6, shown.length - 0.4], tickfont: { color: css("--ink"), size: 13 }, showgrid: false },
  });
}

function drawSummary() {
  const rows = rowsOf("summary");
  const best = {};
  for (const name of SHOWN) {
    const values = rows.filter((row) => row.kind === "model" && known(row[name])).map((row) => row[name]);
    best[name] = values.length > 1 ? Math[METRICS[name].better > 0 ? "max" : "min"](...values) : null;
  }
  const head = make("tr", {}, make("th", {}, "model"), make("th", {}, "seeds"), ...SHOWN.map((name) => make("th", {}, headOf(name))));
  const body = rows.map((row) => {
    const label = make("td", {});
    if (row.kind === "model") {
      const dot = make("span", { class: "dot" });
      dot.style.background = colourOf(row.model);
      label.append(dot);
    }
    label.append(row.model);
    const cells = SHOWN.map((name) => {
      const cell = make("td", row[name] === best[name] && row.kind === "model" ? { class: "best" } : {}, number(name, row[name]));
      if (known(row[`${name}_from`])) cell.append(make("small", {}, `${number(name, row[`${name}_from`])} – ${number(name, row[`${name}_to`])}`));
      return cell;
    });
    return make("tr", { class: row.kind }, label, make("td", {}, known(row.seeds) ? String(row.seeds) : ""), ...cells);
  });
  const count = rows.find((row) => row.kind === "model");
  const caption = count ? `${grouped(count.num_goals)} goals, ${known(count.num_episodes) ? grouped(count.num_episodes) : "no"} episodes per seed` : "no evaluation";
  $("summary").replaceChildren(make("caption", {}, caption), make("thead", {}, head), make("tbody", {}, ...body));
  $("summary").caption.style.cssText = "caption-side:bottom;text-align:left;padding:8px 14px;color:var(--muted);font-size:0.84rem;border-top:1px solid var(--line)";
}

function drawDistance() {
  const name = $("distance-measure").value;
  const order = [...new Map(DATA.tables.distance.map((row) => [row.from, row.distance])).entries()].sort((a, b) => a[0] - b[0]).map((entry) => entry[1]);
  const traces = DATA.models.map((model) => {
    const rows = DATA.tables.distance.filter((row) => row.model === model.label);
    const value = (row, end = "") => scaled(name, row[name + end]);
    return {
      type: "scatter", mode: "lines+markers", name: plain(model.label), x: rows.map((row) => row.distance), y: rows.map((row) => value(row)),
      line: { color: colourOf(model.label), width: 2.5, dash: DASHES[place(model.label) % 8] },
      marker: { size: 9, symbol: SYMBOLS[place(model.label) % 8], color: colourOf(model.label) },
      error_y: { type: "data", symmetric: false, array: rows.map((row) => value(row, "_high") - value(row)), arrayminus: rows.map((row) => value(row) - value(row, "_low")), thickness: 1.5, width: 4, color: colourOf(model.label) },
      text: rows.map((row) => `${grouped(row.num_goals)} goals, ${row.seeds} seed${row.seeds > 1 ? "s" : ""}`), hovertemplate: `<b>${plain(model.label)}</b><br>%{y:.1f} %, %{text}<extra></extra>`,
    };
  }).filter((trace) => trace.x.length);
  plot("distance-plot", traces, {
    height: 380, showlegend: true, xaxis: { title: "actions from the nearest trained goal", type: "category", categoryorder: "array", categoryarray: order },
    yaxis: { title: narrow() ? headOf(name) : titleOf(name).replace(/:.*\(/, " ("), rangemode: "tozero", ticksuffix: " %", autorangeoptions: { clipmax: 103 } },
  });
}

const CURVES = {
  "eval/trained/success": "success, trained goals (%)", "eval/validation/success": "success, validation goals (%)",
  "eval/trained/spl": "SPL, trained goals (%)", "eval/validation/spl": "SPL, validation goals (%)",
  "eval/trained/length_ratio": "length over shortest path, trained goals", "eval/validation/length_ratio": "length over shortest path, validation goals",
  success: "success of the episodes that ended (%)", length: "length of successful episodes (actions)", length_ratio: "length over shortest path",
  collisions: "blocked actions (% of all)", explained_variance: "explained variance of the returns", entropy: "entropy of the policy (nats)",
  kl: "KL of the latent from N(0, 1) (nats)", loss_critic: "critic loss", loss_successor: "successor feature loss", hindsight_value: "value of hindsight goals", grad_norm: "gradient norm",
};

function running(values, width) {
  const half = (width - 1) / 2;
  return values.map((value, at) => {
    if (!known(value)) return null;
    const near = values.slice(Math.max(0, at - half), at + half + 1).filter(known);
    return near.reduce((sum, item) => sum + item, 0) / near.length;
  });
}

function drawCurves() {
  const [measure, scene, axis] = [$("curve").value, $("curve-scene").value, $("curve-axis").value];
  $("smooth").disabled = measure.startsWith("eval/");  // few points, and exact
  const width = $("smooth").disabled ? 1 : Number($("smooth").value);
  const general = !DATA.curves.some((item) => item.name.startsWith("scene/") && item.name.split("/").slice(2).join("/") === measure);
  $("curve-scene").disabled = general;
  const name = scene && !general ? `scene/${scene}/${measure}` : measure;
  const factor = /(^|\/)(success|spl|collisions)$/.test(measure) ? 100 : 1;
  const traces = [];
  for (const curve of DATA.curves.filter((item) => item.name === name && item.x.length)) {
    const x = axis === "x" ? curve.x : curve.minutes;
    const [mean, low, high] = [curve.mean, curve.low, curve.high].map((part) => running(part, width).map((value) => (known(value) ? factor * value : null)));
    const colour = colourOf(curve.model);
    if (curve.seeds > 1) {
      const edge = { type: "scatter", mode: "lines", x, line: { width: 0 }, hoverinfo: "skip", showlegend: false, legendgroup: curve.model };
      traces.push({ ...edge, y: low }, { ...edge, y: high, fill: "tonexty", fillcolor: faded(colour, 0.2) });
    }
    traces.push({
      type: "scatter", mode: "lines", x, y: mean, name: `${plain(curve.model)} (${curve.seeds} seed${curve.seeds > 1 ? "s" : ""})`, legendgroup: curve.model,
      line: { color: colour, width: 2.5, dash: DASHES[place(curve.model) % 8] }, hovertemplate: "%{y:.4g}",
    });
  }
  plot("curves", traces, {
    height: 400, hovermode: "x unified", showlegend: true,
    xaxis: { title: axis === "x" ? "frames (actions of all environments)" : "minutes of training", rangemode: "tozero", hoverformat: axis === "x" ? ",.0f" : ".1f" },
    yaxis: { title: narrow() ? measure.split("/").at(-1) : CURVES[measure] || measure, rangemode: "tozero", type: measure.endsWith("length_ratio") ? "log" : "linear", ticksuffix: factor === 100 ? " %" : "" },
  });
}

function drawRuns() {
  const share = (value) => (known(value) ? (100 * value).toFixed(1) : "–");
  const rows = DATA.tables.runs;
  const logged = (key) => rows.some((row) => row[key] !== "" && row[key] !== null) && (key !== "scenes" || new Set(rows.map((row) => row.scenes)).size > 1);
  const columns = [
    ["model", "model", String], ["seed", "seed", String], ["folder", "folder", String], ["frames", "frames", (v) => (known(v) ? grouped(v) : "–")],
    ["minutes", "minutes", (v) => (known(v) ? v.toFixed(1) : "–")], ["device", "device", String], ["history", "frames seen", (v) => (known(v) ? String(v) : "–")],
    ["trained_success", "trained goals (%)", share], ["unseen_success", "unseen goals (%)", share], ["evaluated", "evaluated", String], ["scenes", "scenes", String],
  ].filter(([key]) => logged(key));
  const left = (key) => (key === "scenes" ? { class: "left wrap" } : ["folder", "device", "evaluated"].includes(key) ? { class: "left" } : {});
  const head = make("tr", {}, ...columns.map(([key, title]) => make("th", left(key), title)));
  const body = rows.map((row) => make("tr", {}, ...columns.map(([key, , format]) => make("td", left(key), format(row[key])))));
  $("run-table").replaceChildren(make("thead", {}, head), make("tbody", {}, ...body));
}

function startCharts() {
  const rows = DATA.tables.summary;
  const unique = (key) => [...new Set(rows.map((row) => row[key]))];
  const scenes = unique("scene");
  const subsets = unique("goals");
  fill($("measure"), SHOWN.map((name) => [name, titleOf(name)]), SHOWN[0]);
  fill($("subset"), subsets.map((name) => [name, name]), subsets.includes("unseen") ? "unseen" : subsets[0]);
  fill($("scene"), [...scenes].sort((a, b) => b.startsWith("mean of") - a.startsWith("mean of")).map((name) => [name, name]));
  fill($("distance-measure"), SHOWN.filter(isShare).map((name) => [name, titleOf(name)]));
  const curves = [...new Set(DATA.curves.map((curve) => curve.name))];
  fill($("curve"), curves.filter((name) => !name.startsWith("scene/")).map((name) => [name, CURVES[name] || name]));
  $("learning-say").textContent = curves.some((name) => name.startsWith("eval/"))
    ? "Success, SPL and length are those of evaluations towards fixed goals, with the weights of that moment; the other curves are of the training itself."
    : "Each point summarizes the episodes that ended since the previous point. The first episodes to end are the short ones, so success begins high, then falls before it rises.";
  const curveScenes = [...new Set(curves.filter((name) => name.startsWith("scene/")).map((name) => name.split("/")[1]))];
  fill($("curve-scene"), [["", "all scenes"], ...curveScenes.map((name) => [name, name])]);
  for (const [ids, draw, wanted] of [
    [["measure", "subset", "scene"], drawOverview, rows.length], [["subset", "scene"], drawSummary, rows.length],
    [["distance-measure"], drawDistance, DATA.tables.distance.length], [["curve", "curve-scene", "curve-axis", "smooth"], drawCurves, curves.length],
  ]) {
    if (!wanted) continue;
    for (const id of ids) $(id).addEventListener("change", draw);
    redraws.push(draw);
  }
  redraws.push(drawRuns);
  $("results").hidden = !rows.length;
  $("distance").hidden = !DATA.tables.distance.length;
  $("learning").hidden = !curves.length;
}
