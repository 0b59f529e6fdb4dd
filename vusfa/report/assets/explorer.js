// The explorer: one agent, one scene, one goal; its value and policy at every state, and an episode, step by step.

const at = { map: null, mapScene: null, way: [], step: 0, timer: null, own: null };

const agentNow = () => DATA.agents[Number($("x-agent").value)];
const sceneNow = () => $("x-scene").value;
const goalIndex = () => DATA.goals[sceneNow()].indexOf(Number($("x-goal").value));
const viewNow = () => agentNow().scenes[sceneNow()];

// Values of the chosen goal, one for each state, of a packed (goals, states) or (goals, states, actions).
function slice(packed, width = 1) {
  const count = DATA.scenes[sceneNow()].states * width;
  return unpack(packed).subarray(goalIndex() * count, (goalIndex() + 1) * count);
}

// Fewest actions from every state to a goal: a search from the goal, backwards.
function actionsToGo(scene, goal) {
  const plan = DATA.scenes[scene], { next } = drawing(scene), width = plan.actions.length;
  plan.back ||= (() => {
    const back = Array.from({ length: plan.states }, () => []);
    next.forEach((to, from) => back[to].push(Math.floor(from / width)));
    return back;
  })();
  const togo = new Float32Array(plan.states).fill(NaN);
  togo[goal] = 0;
  for (let queue = [goal]; queue.length; ) {
    const further = [];
    for (const state of queue) for (const from of plan.back[state]) if (Number.isNaN(togo[from])) { togo[from] = togo[state] + 1; further.push(from); }
    queue = further;
  }
  return togo;
}

function likeliest(shares, state, width) {
  let best = 0;
  for (let action = 1; action < width; action++) if (shares[state * width + action] > shares[state * width + best]) best = action;
  return best;
}

function layerNow() {
  const view = viewNow(), name = $("x-layer").value, width = DATA.scenes[sceneNow()].actions.length;
  const two = (value) => value.toFixed(2).replace("-", "−");
  if (name === "value") return { values: slice(view.value), low: view.value.low, high: view.value.high, stops: VIRIDIS, unit: "discounted reward", words: two };
  if (name === "sure") {
    const shares = slice(view.probabilities, width);
    const values = Float32Array.from({ length: shares.length / width }, (_, state) => shares[state * width + likeliest(shares, state, width)]);
    return { values, low: 1 / width, high: 1, stops: VIRIDIS, unit: "", words: percent };
  }
  if (name === "togo") {
    const values = actionsToGo(sceneNow(), Number($("x-goal").value));
    return { values, low: values.reduce((most, value) => Math.max(most, value || 0), 1), high: 0, stops: VIRIDIS, unit: "actions", words: (value) => value.toFixed(0) };
  }
  const packed = view.components[Number(name.slice(3))];
  return { values: slice(packed), low: packed.low, high: packed.high, stops: DIVERGING, unit: "in the unit of ψ", words: two };
}

function paintExplorer() {
  const layer = layerNow();
  at.layer = layer;
  at.map.paint((state) => ramp(layer.stops, (layer.values[state] - layer.low) / (layer.high - layer.low)));
  drawScale($("x-scale"), layer.stops, layer.words(layer.low), layer.words(layer.high), layer.unit);
  drawArrows();
}

function drawArrows() {
  const host = at.map.layer("arrows"), scene = sceneNow(), plan = DATA.scenes[scene], width = plan.actions.length;
  if (!$("x-arrows").checked) return host.replaceChildren();
  const { middles, next } = drawing(scene), shares = slice(viewNow().probabilities, width);
  const drawn = ["", "", "", ""]; // by how sure the agent is
  for (let state = 0; state < plan.states; state++) {
    if (state === Number($("x-goal").value)) continue;
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
  const scene = sceneNow(), goal = Number($("x-goal").value), { x, y, width } = drawing(scene), size = Math.max(0.42, width * 0.026);
  const line = (states) => states.map((state) => `${x[state].toFixed(2)},${y[state].toFixed(2)}`).join(" ");
  const stroke = Math.max(0.13, width * 0.008);
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
  drawActions(state);
}

function drawActions(state) {
  const plan = DATA.scenes[sceneNow()], width = plan.actions.length, shares = slice(viewNow().probabilities, width), { next } = drawing(sceneNow());
  const here = state === Number($("x-goal").value);
  $("x-actions").replaceChildren(...plan.actions.flatMap((action, i) => {
    const share = shares[state * width + i];
    const bar = make("div", { class: "fill" });
    bar.style.width = `${(here ? 0 : 100 * share).toFixed(1)}%`;
    const wall = next[state * width + i] === state ? " (blocked)" : "";
    return [make("span", {}, action.replace(/(?<=[a-z])(?=[A-Z])/g, " ").toLowerCase() + wall), make("div", { class: "track" }, bar), make("span", { class: "share" }, here ? "–" : percent(share))];
  }));
}

function showWalk(way) {
  pause();
  at.way = way;
  at.step = 0;
  const goal = Number($("x-goal").value), arrived = way.at(-1) === goal, shortest = actionsToGo(sceneNow(), goal)[way[0]], count = way.length - 1;
  const best = Number.isFinite(shortest) ? `the shortest path has ${shortest}` : "there is no path";
  $("x-status").textContent = arrived ? `Arrives after ${count} action${count === 1 ? "" : "s"}; ${best}.` : `Has not arrived after ${count} actions; ${best}.`;
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
    at.step += 1;
    drawWalk();
    if (at.step >= at.way.length - 1) pause();
  }, at.way.length > 80 ? 60 : 220);
}

// An episode sampled in the page: correct for agents that see one frame, whose actions depend on nothing else.
function walkFrom(start) {
  const scene = sceneNow(), goal = Number($("x-goal").value), width = DATA.scenes[scene].actions.length;
  const shares = slice(viewNow().probabilities, width), { next } = drawing(scene), way = [start];
  for (let state = start; state !== goal && way.length <= agentNow().max_steps; ) {
    let draw = Math.random(), action = 0;
    while (action < width - 1 && (draw -= shares[state * width + action]) >= 0) action += 1;
    way.push((state = next[state * width + action]));
  }
  at.own = way;
  listWalks("own");
  showWalk(way);
}

function listWalks(chosen = 0) {
  const ways = viewNow().walks[goalIndex()], goal = Number($("x-goal").value);
  const name = (way, i) => [i, `${i + 1}: ${way.length - 1} actions${way.at(-1) === goal ? "" : ", failed"}`];
  fill($("x-walk"), [...ways.map(name), ...(at.own ? [["own", "from the pose that you chose"]] : [])], chosen);
}

function chooseGoal() {
  at.own = null;
  listWalks();
  paintExplorer();
  showWalk(viewNow().walks[goalIndex()][0] || [Number($("x-goal").value)]);
  $("x-again").disabled = !agentNow().markov;
}

function listGoals(wanted) {
  const agent = agentNow(), scene = sceneNow(), before = wanted ?? Number($("x-goal").value);
  const row = DATA.maps.find((item) => item.model === agent.model && item.scene === scene);
  const hardest = row && row[DATA.hardest] && DATA.hardest;
  fill($("x-goal"), DATA.goals[scene].map((goal) => {
    const trained = agent.trained[scene]?.includes(goal) ? " · trained" : "";
    const success = hardest ? ` · ${percent(unpack(row[hardest])[goal])} ${headOf(hardest)}` : "";
    return [goal, `${goal}${trained}${success}`];
  }), before);
  chooseGoal();
}

function chooseScene(wanted) {
  const scene = sceneNow();
  if (at.mapScene !== scene) {
    const host = make("div", { class: "floor", id: "x-map" });
    $("x-map").replaceWith(host); // with its listeners
    at.map = floorMap(host, scene, `Map of ${words(scene)}`);
    at.mapScene = scene;
    at.map.listen(
      (state, event) => {
        const width = DATA.scenes[scene].actions.length, shares = slice(viewNow().probabilities, width), action = likeliest(shares, state, width);
        const does = `${DATA.scenes[scene].actions[action].replace(/(?<=[a-z])(?=[A-Z])/g, " ").toLowerCase()} ${percent(shares[state * width + action])}`;
        const value = at.layer.values[state];
        tell(event, ...tipOf(scene, state, `state ${state}: ${Number.isFinite(value) ? at.layer.words(value) : "–"} ${at.layer.unit}`, does));
      },
      (state) => { if (agentNow().markov && state !== Number($("x-goal").value)) walkFrom(state); },
    );
  }
  listGoals(wanted);
}

function chooseAgent(wanted) {
  const agent = agentNow(), scenes = Object.keys(agent.scenes), before = $("x-layer").value, explained = agent.scenes[scenes[0]].explained;
  fill($("x-scene"), scenes.map((name) => [name, words(name)]), sceneNow());
  const components = explained ? explained.map((_, i) => [`psi${i}`, `ψ, component ${i + 1}`]) : [];
  fill($("x-layer"), [["value", "value"], ...components, ["sure", "probability of the most probable action"], ["togo", "shortest path"]], before || "value");
  $("x-note").textContent = [
    agent.markov ? "Click a pose on the map to start the agent there. Such episodes are sampled in this page from the policy's probabilities." : `This agent ${agent.history > 1 ? `sees its last ${agent.history} frames` : "has a memory"}; map and bars show its policy at the beginning of an episode.`,
    explained ? "" : `${agent.model} has no ψ.`,
  ].join(" ");
  chooseScene(wanted);
  sayShares();
}

function sayShares() {
  const { explained } = viewNow();
  const shares = explained ? ` The components explain ${explained.map((share) => percent(share)).join(", ")} of the variance of ψ over these goals.` : "";
  $("x-caption").textContent = `Orange: the goal. White: the agent. Arrows: the most probable action, fainter where its probability is lower; sideways arrows are turns.${shares}`;
}

function openGoal(label, scene, goal, event) {
  const index = DATA.agents.findIndex((agent) => agent.model === label && agent.scenes[scene]);
  const found = index >= 0 ? index : DATA.agents.findIndex((agent) => agent.scenes[scene]);
  if (found < 0 || !DATA.goals[scene].includes(goal)) return tell(event, `The explorer has ${DATA.goals[scene].length} goals of this scene; goal ${goal} is not among them.`);
  hush();
  $("x-agent").value = found;
  fill($("x-scene"), Object.keys(agentNow().scenes).map((name) => [name, words(name)]));
  $("x-scene").value = scene;
  chooseAgent(goal);
  $("explorer").scrollIntoView();
}

function startExplorer() {
  $("explorer").hidden = !DATA.agents.length;
  if (!DATA.agents.length) return;
  const most = Math.max(...Object.values(DATA.goals).map((goals) => goals.length));
  $("explorer-say").textContent = `Choose a model, a scene and a goal. The map shows the value of every pose for that goal and the most probable action there, the pictures what the agent sees. Each scene has up to ${most} goals: trained ones, those reached least, and some spread over the room.`;
  fill($("x-agent"), DATA.agents.map((agent, i) => [i, `${agent.name}`]));
  $("x-agent").addEventListener("change", () => chooseAgent());
  $("x-scene").addEventListener("change", () => { chooseScene(); sayShares(); });
  $("x-goal").addEventListener("change", chooseGoal);
  $("x-layer").addEventListener("change", paintExplorer);
  $("x-arrows").addEventListener("change", drawArrows);
  $("x-walk").addEventListener("change", () => showWalk($("x-walk").value === "own" ? at.own : viewNow().walks[goalIndex()][Number($("x-walk").value)]));
  $("x-step").addEventListener("input", () => { pause(); at.step = Number($("x-step").value); drawWalk(); });
  $("x-play").addEventListener("click", play);
  $("x-again").addEventListener("click", () => walkFrom(at.way[at.step] === Number($("x-goal").value) ? at.way[0] : at.way[at.step]));
  chooseAgent();
}
