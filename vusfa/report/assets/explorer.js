// The explorer: one agent, one scene, one goal; its value and policy at every state, and an episode, step by step.

const at = { map: null, mapScene: null, way: [], step: 0, timer: null, own: null, yours: false, tries: 0, layer: null };

const agentNow = () => DATA.agents[Number($("x-agent").value)];
const sceneNow = () => $("x-scene").value;
const goalNow = () => Number($("x-goal").value);
const viewNow = () => agentNow().scenes[sceneNow()];
const widthNow = () => DATA.scenes[sceneNow()].actions.length;
const inWords = (action) => action.replace(/(?<=[a-z])(?=[A-Z])/g, " ").toLowerCase();

// Values of a goal, one for each state, of a packed (goals, states) or (goals, states, actions).
function slice(packed, width = 1, goal = goalNow()) {
  const count = DATA.scenes[sceneNow()].states * width, row = DATA.goals[sceneNow()].indexOf(goal);
  return unpack(packed).subarray(row * count, (row + 1) * count);
}

const sharesNow = (goal = goalNow()) => slice(viewNow().probabilities, widthNow(), goal);

// Probability of arriving from every state; kept for the goal that was looked at last.
function arrivalNow(goal = goalNow()) {
  const key = `${$("x-agent").value}/${sceneNow()}/${goal}`;
  if (at.arrival?.key !== key) at.arrival = { key, values: arrival(drawing(sceneNow()), sharesNow(goal), widthNow(), goal, agentNow().max_steps) };
  return at.arrival.values;
}

const GAMMA = 0.99; // where a training does not tell its own

const LAYERS = {
  value: (view) => ({ values: slice(view.value), low: view.value.low, high: view.value.high, stops: VIRIDIS, unit: "discounted reward", say: "The reward that the agent expects from each pose on its way to this goal." }),
  occupancy: () => {
    const agent = agentNow(), gamma = agent.gamma ?? GAMMA;
    const values = occupancy(drawing(sceneNow()), sharesNow(), widthNow(), at.way[at.step], goalNow(), gamma, agent.max_steps);
    const high = Math.max(...values.filter((_, state) => state !== at.way[at.step]), 0.01);
    return { values, low: 0, high, curve: (share) => Math.sqrt(share), stops: HEAT, unit: "visits", say: `Expected visits of each pose by an episode that begins at the white agent, discounted by ${gamma} per action. ψ predicts the same sum, of embeddings instead of visits.` };
  },
  arrive: () => ({ values: arrivalNow(), low: 0, high: 1, stops: VIRIDIS, unit: "", words: percent, say: `Probability of arriving within ${agentNow().max_steps} actions, computed from the policy.` }),
  sure: (view) => {
    const width = widthNow(), shares = slice(view.probabilities, width);
    const values = Float32Array.from({ length: shares.length / width }, (_, state) => shares[state * width + likeliest(shares, state, width)]);
    return { values, low: 1 / width, high: 1, stops: VIRIDIS, unit: "", words: percent, say: "How sure the agent is of its action." };
  },
  togo: () => {
    const values = actionsToGo(sceneNow(), goalNow());
    return { values, low: values.reduce((most, value) => Math.max(most, value || 0), 1), high: 0, stops: VIRIDIS, unit: "actions", words: (value) => value.toFixed(0), say: "What a perfect agent would need from each pose." };
  },
};

function layerNow() {
  const view = viewNow(), name = $("x-layer").value;
  const words = (value) => value.toFixed(2).replace("-", "−");
  if (LAYERS[name]) return { words, ...LAYERS[name](view) };
  const number = Number(name.slice(3)), packed = view.components[number];
  const said = `Where ψ differs most between poses and goals${number ? `, apart from the ${number === 1 ? "first component" : `first ${number} components`}` : ""}. Its sign has no meaning of its own.`;
  return { values: slice(packed), low: packed.low, high: packed.high, stops: DIVERGING, unit: "in the unit of ψ", words, say: said };
}

function paintExplorer() {
  const layer = layerNow(), stops = tone(layer.stops), curve = layer.curve || ((share) => share);
  at.layer = layer;
  at.map.paint((state) => ramp(stops, curve(Math.min(1, Math.max(0, (layer.values[state] - layer.low) / (layer.high - layer.low))))));
  drawScale($("x-scale"), layer.stops, layer.words(layer.low), layer.words(layer.high), layer.unit);
  $("x-layer-say").textContent = layer.say;
  drawArrows();
}

function drawArrows() {
  const host = at.map.layer("arrows"), scene = sceneNow(), plan = DATA.scenes[scene], width = widthNow();
  if (!$("x-arrows").checked) return host.replaceChildren();
  const { middles, next } = drawing(scene), shares = sharesNow();
  const drawn = ["", "", "", ""]; // by how sure the agent is
  for (let state = 0; state < plan.states; state++) {
    if (state === goalNow()) continue;
    const action = likeliest(shares, state, width), to = next[state * width + action];
    const level = Math.min(3, Math.max(0, Math.floor(((shares[state * width + action] - 1 / width) / (1 - 1 / width)) * 4)));
    const [x, y] = middles[state];
    if (to === state) { drawn[level] += `M${(x - 0.06).toFixed(3)} ${y.toFixed(3)}h0.12`; continue; }
    let dx = middles[to][0] - x, dy = middles[to][1] - y;
    const long = Math.hypot(dx, dy) || 1;
    dx /= long; dy /= long;
    const point = (along, aside) => `${(x + along * dx - aside * dy).toFixed(3)} ${(y + along * dy + aside * dx).toFixed(3)}`;
    drawn[level] += `M${point(-0.11, 0)}L${point(0.12, 0)}M${point(0.03, 0.075)}L${point(0.12, 0)}L${point(0.03, -0.075)}`;
  }
  const groups = drawn.map((d, level) => d && svg("g", { opacity: [0.25, 0.5, 0.75, 1][level] }, svg("path", { class: "arrow-under", d }), svg("path", { class: "arrow", d })));
  host.replaceChildren(...groups.filter(Boolean));
}

function dart(state, size, fill, edge) {
  const { middles, heading } = DATA.scenes[sceneNow()], [x, y] = middles[state];
  const transform = `translate(${x} ${y}) rotate(${heading[state]}) scale(${size})`;
  return svg("path", { d: DATA.dart, transform, fill, stroke: edge, "stroke-width": 0.2, "stroke-linejoin": "round" });
}

function drawWalk() {
  const scene = sceneNow(), goal = goalNow(), { x, y } = drawing(scene), pixel = 1 / at.map.scale, size = Math.max(0.42, 10 * pixel);
  const line = (states) => states.map((state) => `${x[state].toFixed(2)},${y[state].toFixed(2)}`).join(" ");
  const stroke = Math.max(0.1, 3 * pixel);
  const trail = (states, color, thickness, opacity = 1) => svg("polyline", { class: "trail", points: line(states), stroke: color, "stroke-width": thickness, opacity });
  const walked = at.way.slice(0, at.step + 1);
  at.map.layer("trail").replaceChildren(trail(at.way, "#10151a", stroke * 1.7, 0.25), trail(walked, "#10151a", stroke * 1.9), trail(walked, "#ffffff", stroke));
  const state = at.way[at.step];
  at.map.layer("marks").replaceChildren(dart(goal, size, "var(--goal)", "#ffffff"), dart(state, size * 0.92, "var(--agent)", "var(--agent-edge)"));
  showPicture($("x-view"), scene, state);
  showPicture($("x-target"), scene, goal);
  $("x-step").max = at.way.length - 1;
  $("x-step").value = at.step;
  $("x-count").value = `${at.step} of ${at.way.length - 1}`;
  if ($("x-layer").value === "occupancy") paintExplorer();
  drawActions(state);
}

function drawActions(state) {
  const plan = DATA.scenes[sceneNow()], width = plan.actions.length, shares = sharesNow(), { next } = drawing(sceneNow());
  const here = state === goalNow();
  $("x-actions").replaceChildren(...plan.actions.flatMap((action, i) => {
    const share = shares[state * width + i];
    const bar = make("div", { class: "fill" });
    bar.style.width = `${(here ? 0 : 100 * share).toFixed(1)}%`;
    const wall = next[state * width + i] === state ? " (blocked)" : "";
    return [make("span", {}, inWords(action) + wall), make("div", { class: "track" }, bar), make("span", { class: "share" }, here ? "–" : percent(share))];
  }));
}

function showWalk(way, step = 0) {
  pause();
  at.way = way;
  at.step = step;
  const goal = goalNow(), arrived = way.at(-1) === goal, shortest = actionsToGo(sceneNow(), goal)[way[0]], count = way.length - 1;
  const best = Number.isFinite(shortest) ? `the shortest path has ${shortest}` : "there is no path";
  const who = at.yours && way === at.own;
  const lost = who ? `You have taken ${plural(count, "action")}` : `Has not arrived after ${count} actions`;
  $("x-status").textContent = arrived ? `${who ? "You arrive" : "Arrives"} after ${plural(count, "action")}; ${best}.` : `${lost}; ${best}.`;
  drawWalk();
}

function pause() {
  clearInterval(at.timer);
  at.timer = null;
  $("x-play").textContent = "▶";
  $("x-play").setAttribute("aria-label", "Play");
}

function play() {
  if (at.timer) return pause();
  if (at.step >= at.way.length - 1) at.step = 0;
  $("x-play").textContent = "❚❚";
  $("x-play").setAttribute("aria-label", "Pause");
  at.timer = setInterval(() => {
    at.step = Math.min(at.step + 1, at.way.length - 1);
    drawWalk();
    if (at.step >= at.way.length - 1) pause();
  }, at.way.length > 80 ? 60 : 220);
}

// An episode sampled in the page: correct for agents that see one frame, whose actions depend on nothing else.
function walkFrom(start) {
  at.own = sampleWalk(drawing(sceneNow()), sharesNow(), widthNow(), start, goalNow(), agentNow().max_steps, 1000 + at.tries++);
  at.yours = false;
  listWalks("own");
  showWalk(at.own);
}

// One action of the reader's own, from where the agent stands.
function drive(action) {
  const { actions } = DATA.scenes[sceneNow()], index = actions.indexOf(action);
  if (index < 0 || at.way[at.step] === goalNow()) return;
  const way = at.way.slice(0, at.step + 1);
  way.push(drawing(sceneNow()).next[way.at(-1) * actions.length + index]);
  at.own = way;
  at.yours = true;
  listWalks("own");
  showWalk(way, way.length - 1);
}

// Those of the file, or sampled here: the same ones whenever the page is opened.
function walksNow() {
  const view = viewNow(), goal = goalNow(), row = DATA.goals[sceneNow()].indexOf(goal);
  if (view.walks) return view.walks[row];
  return view.starts[row].map((start, i) => sampleWalk(drawing(sceneNow()), sharesNow(), widthNow(), start, goal, agentNow().max_steps, i));
}

function listWalks(chosen = 0) {
  const goal = goalNow();
  const name = (way, i) => [i, `${i + 1}: ${plural(way.length - 1, "action")}${way.at(-1) === goal ? "" : ", failed"}`];
  fill($("x-walk"), [...at.walks.map(name), ...(at.own ? [["own", at.yours ? "yours" : "from the pose that you chose"]] : [])], chosen);
}

function chooseGoal() {
  at.own = null;
  at.tries = 0;
  at.walks = walksNow();
  at.way = at.walks[0] || [goalNow()];
  at.step = 0;
  listWalks();
  paintExplorer();
  showWalk(at.way);
  $("x-again").disabled = !agentNow().markov;
}

// Success of each goal, of this agent's model, where it was measured.
function successOf(agent, scene) {
  const row = DATA.maps.find((item) => item.model === agent.model && item.scene === scene);
  return row && row[DATA.hardest] ? unpack(row[DATA.hardest]) : null;
}

// How often a goal is reached: computed where the page can, else whether its first episode arrives.
function reached(goal) {
  if (agentNow().markov) return meanOverStarts(arrivalNow(goal), actionsToGo(sceneNow(), goal));
  const way = viewNow().walks[DATA.goals[sceneNow()].indexOf(goal)][0];
  return way && way.at(-1) === goal ? 1 : 0;
}

const TRIED = 12; // goals that are computed to find a good or a bad one

// The goals in an order, best first: trained ones, then those with most success.
function ranked() {
  const agent = agentNow(), scene = sceneNow(), success = successOf(agent, scene), trained = agent.trained[scene] || [];
  const rank = (goal) => (trained.includes(goal) ? 2 : 0) + (success && known(success[goal]) ? success[goal] : 0.5);
  return [...DATA.goals[scene]].sort((a, b) => rank(b) - rank(a));
}

function bestGoal() {
  let best = null;
  for (const goal of ranked().slice(0, TRIED)) {
    const share = reached(goal);
    if (share > 0.9) return { goal, share };
    if (!best || share > best.share) best = { goal, share };
  }
  return best;
}

function worstGoal() {
  let worst = null;
  for (const goal of ranked().reverse().slice(0, TRIED)) {
    const share = reached(goal);
    if (!worst || share < worst.share) worst = { goal, share };
  }
  return worst;
}

function listGoals(wanted) {
  const agent = agentNow(), scene = sceneNow(), success = successOf(agent, scene), before = wanted ?? goalNow();
  fill($("x-goal"), DATA.goals[scene].map((goal) => {
    const trained = agent.trained[scene]?.includes(goal) ? " · trained" : "";
    return [goal, `${goal}${trained}${success ? ` · ${percent(success[goal])} ${headOf(DATA.hardest)}` : ""}`];
  }), at.listed === scene || wanted !== undefined ? before : undefined);
  if (at.listed !== scene && wanted === undefined) $("x-goal").value = bestGoal().goal;
  at.listed = scene;
  chooseGoal();
}

function chooseScene(wanted) {
  const scene = sceneNow(), plan = DATA.scenes[scene];
  if (at.mapScene !== scene) {
    const host = make("div", { class: "floor", id: "x-map", tabindex: 0, role: "application", "aria-label": `Map of ${scene}: arrow keys move the agent` });
    $("x-map").replaceWith(host); // with its listeners
    at.map = floorMap(host, scene, `Map of ${scene}`);
    at.mapScene = scene;
    at.map.listen(
      (state, event) => {
        const width = widthNow(), shares = sharesNow(), action = likeliest(shares, state, width), value = at.layer.values[state];
        const does = `${inWords(plan.actions[action])} ${percent(shares[state * width + action])}`;
        tell(event, ...tipOf(scene, state, `state ${state}: ${Number.isFinite(value) ? at.layer.words(value) : "–"} ${at.layer.unit}`, does));
      },
      (state) => { if (agentNow().markov && state !== goalNow()) { walkFrom(state); writeLink(); } },
    );
    $("x-ground-label").hidden = !plan.room && !plan.edges?.length;
    $("x-ground-label").querySelector("span").textContent = plan.room ? "walls and furniture" : "blocked steps";
  }
  listGoals(wanted);
}

function chooseAgent(wanted) {
  const agent = agentNow(), scenes = Object.keys(agent.scenes), before = $("x-layer").value;
  fill($("x-scene"), scenes.map((name) => [name, name]), sceneNow());
  $("x-note").textContent = [
    agent.markov ? "Click a pose on the map to start the agent there. Episodes are sampled in this page from the policy's probabilities." : `This agent ${agent.history > 1 ? `sees its last ${agent.history} frames` : "has a memory"}; map and bars show its policy at the beginning of an episode.`,
    agent.scenes[scenes[0]].explained ? "" : `${agent.model} has no ψ.`,
  ].join(" ");
  listLayers(before);
  chooseScene(wanted);
}

function listLayers(before) {
  const { explained } = viewNow();
  const components = (explained || []).map((share, i) => [`psi${i}`, `ψ, principal component ${i + 1} (${percent(share)} of its variance)`]);
  const computed = agentNow().markov ? [["occupancy", "expected occupancy"], ["arrive", "probability of arriving"]] : [];
  fill($("x-layer"), [["value", "value"], ...computed, ...components, ["sure", "probability of the most probable action"], ["togo", "shortest path"]], before || "value");
}

// The goal on this page whose pose is nearest to a state.
function nearestGoal(scene, state) {
  const { x, y, heading } = DATA.scenes[scene];
  const turn = (goal) => Math.abs(((heading[goal] - heading[state] + 540) % 360) - 180) / 180;
  const far = (goal) => Math.hypot(x[goal] - x[state], y[goal] - y[state]) + 0.5 * turn(goal);
  return DATA.goals[scene].reduce((best, goal) => (far(goal) < far(best) ? goal : best));
}

function notice(text) {
  $("x-notice").textContent = text;
  $("x-notice").hidden = !text;
}

function openGoal(label, scene, wanted) {
  const index = DATA.agents.findIndex((agent) => agent.model === label && agent.scenes[scene]);
  const found = index >= 0 ? index : DATA.agents.findIndex((agent) => agent.scenes[scene]);
  if (found < 0) return;
  hush();
  const goal = DATA.goals[scene].includes(wanted) ? wanted : nearestGoal(scene, wanted);
  const others = [index < 0 ? `${label} is not in the explorer; this is ${DATA.agents[found].name}.` : "", goal === wanted ? "" : `To keep the page small, it has ${DATA.goals[scene].length} of the ${DATA.scenes[scene].states} goals of ${scene}; this is goal ${goal}, the nearest one to ${wanted}.`];
  show({ agent: found, scene, goal });
  notice(others.filter(Boolean).join(" "));
  writeLink();
  $("explorer").scrollIntoView();
}

function show({ agent, scene, goal }) {
  $("x-agent").value = agent;
  fill($("x-scene"), Object.keys(agentNow().scenes).map((name) => [name, name]));
  $("x-scene").value = scene;
  chooseAgent(goal);
}

function startExplorer() {
  $("explorer").hidden = !DATA.agents.length;
  if (!DATA.agents.length) return;
  $("explorer-say").textContent = "Choose a model, a scene and a goal. The map shows what the agent makes of every pose on its way to that goal, and the most probable action there; the pictures show what it sees.";
  $("x-caption").textContent = "Orange: the goal. White: the agent. Arrows: the most probable action, fainter where its probability is lower; sideways arrows are turns.";
  fill($("x-agent"), DATA.agents.map((agent, i) => [i, agent.name]));
  const also = (choose) => () => { notice(""); guideTo(0); choose(); writeLink(); };
  $("x-agent").addEventListener("change", also(() => chooseAgent()));
  $("x-scene").addEventListener("change", also(() => { listLayers($("x-layer").value); chooseScene(); }));
  $("x-goal").addEventListener("change", also(chooseGoal));
  $("x-layer").addEventListener("change", also(paintExplorer));
  $("x-arrows").addEventListener("change", drawArrows);
  $("x-ground").addEventListener("change", () => $("x-map-host").classList.toggle("no-ground", !$("x-ground").checked));
  $("x-walk").addEventListener("change", () => showWalk($("x-walk").value === "own" ? at.own : at.walks[Number($("x-walk").value)]));
  $("x-step").addEventListener("input", () => { pause(); at.step = Number($("x-step").value); drawWalk(); });
  $("x-play").addEventListener("click", play);
  $("x-again").addEventListener("click", () => walkFrom(at.way[at.step] === goalNow() ? at.way[0] : at.way[at.step]));
  redraws.push(paintExplorer);
  chooseAgent();
  startGuide();
  startKeys();
  addEventListener("hashchange", readLink);
}
