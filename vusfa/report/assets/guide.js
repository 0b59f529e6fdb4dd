// Ways into the explorer: links to a state, the first minute in three steps, keys.

// ---- links, such as #scene=kitchen&goal=42

// What the address names is shown; what it names and the page has not is said.
function readLink() {
  if (!location.hash.includes("=")) return;
  const link = new URLSearchParams(location.hash.slice(1)), wrong = [];
  const choose = (name, now, has, all) => {
    if (!link.has(name)) return now;
    if (has(link.get(name))) return link.get(name);
    wrong.push(`${name} “${link.get(name).slice(0, 40)}”${all ? ` (there ${all.length === 1 ? "is" : "are"} ${all.join(", ")})` : ""}`);
    return now;
  };
  const names = DATA.agents.map((agent) => agent.name);
  const agent = names.indexOf(choose("agent", agentNow().name, (name) => names.includes(name), names));
  const scenes = Object.keys(DATA.agents[agent].scenes), first = scenes.includes(sceneNow()) ? sceneNow() : scenes[0];
  const scene = choose("scene", first, (name) => scenes.includes(name), scenes), { states } = DATA.scenes[scene];
  const isState = (text) => /^\d+$/.test(text) && Number(text) < states;
  const asked = choose("goal", undefined, isState), goal = asked === undefined ? undefined : Number(asked);
  const held = goal === undefined || DATA.goals[scene].includes(goal);
  at.listed = at.listed === scene ? scene : null;
  show({ agent, scene, goal: held ? goal : nearestGoal(scene, goal) });
  const colors = [...$("x-layer").options].map((option) => option.value);
  $("x-layer").value = choose("color", $("x-layer").value, (name) => colors.includes(name), colors);
  paintExplorer();
  const from = choose("from", undefined, isState);
  if (from !== undefined && agentNow().markov && Number(from) !== goalNow()) walkFrom(Number(from));
  const nearest = held ? "" : `Goal ${goal} is not on this page; this is goal ${goalNow()}, the nearest one.`;
  notice([wrong.length ? `The link names what this page has not: ${wrong.join("; ")}.` : "", nearest].filter(Boolean).join(" "));
  $("explorer").scrollIntoView();
}

// The address follows what is shown, so that it can be copied.
function writeLink() {
  const link = new URLSearchParams();
  if (DATA.agents.length > 1) link.set("agent", agentNow().name);
  link.set("scene", sceneNow());
  link.set("goal", goalNow());
  if ($("x-layer").value !== "value") link.set("color", $("x-layer").value);
  if (at.own && !at.yours && agentNow().markov) link.set("from", at.own[0]);
  history.replaceState(null, "", `#${link}`);
}

// ---- the first minute

function guideTo(step) {
  for (const number of [1, 2, 3]) $(`guide-${number}`).setAttribute("aria-pressed", String(number === step));
  if (!step) $("guide-say").textContent = "";
}

function look(goal, layer) {
  notice("");
  $("x-layer").value = layer;
  $("x-goal").value = goal;
  chooseGoal();
}

function guide(step) {
  const { markov, max_steps: limit } = agentNow();
  const { goal, share } = step === 3 ? worstGoal() : bestGoal();
  look(goal, step === 1 || !markov ? "value" : step === 2 ? "occupancy" : "arrive");
  guideTo(step);
  const count = at.way.length - 1, best = actionsToGo(sceneNow(), goal)[at.way[0]], arrived = at.way.at(-1) === goal;
  const often = markov ? `It arrives at goal ${goal} within ${limit} actions with a probability of ${percent(share)}, the mean over all starts.` : `Its first episode to goal ${goal} ${arrived ? "arrives" : "fails"}.`;
  $("guide-say").textContent = {
    1: `Bright poses promise reward soon: value should rise from everywhere towards the goal (orange), through doors and around furniture. The arrows show what the agent makes of it. ${often}`,
    2: `From one of the farthest poses it ${arrived ? `takes ${plural(count, "action")}` : `has not arrived after ${plural(count, "action")}`}; the shortest path has ${best}. ${markov ? "The color shows where such episodes will still pass: the expected occupancy shrinks towards the goal as it walks." : "Watch where value guides it."}`,
    3: `${markov && share > 0.99 ? "It hardly fails: this is the goal that it reaches least often. " : ""}${often} ${markov ? "From dark poses it does not arrive: follow the arrows, they lead around in circles or into a wall." : "Follow the arrows from where it stops."}`,
  }[step];
  if (step !== 1) play();
  writeLink();
}

function startGuide() {
  for (const step of [1, 2, 3]) $(`guide-${step}`).addEventListener("click", () => guide(step));
}

// ---- keys

const DRIVES = { ArrowUp: "MoveForward", ArrowDown: "MoveBackward", ArrowLeft: "RotateLeft", ArrowRight: "RotateRight" };

function turnOver(select, by) {
  const count = select.options.length;
  select.selectedIndex = (select.selectedIndex + by + count) % count;
  select.dispatchEvent(new Event("change"));
}

function stepBy(by) {
  pause();
  at.step = Math.min(Math.max(0, at.step + by), at.way.length - 1);
  drawWalk();
}

const KEYS = {
  " ": play, ",": () => stepBy(-1), ".": () => stepBy(1), g: () => turnOver($("x-goal"), 1), G: () => turnOver($("x-goal"), -1),
  c: () => turnOver($("x-layer"), 1), C: () => turnOver($("x-layer"), -1), 1: () => guide(1), 2: () => guide(2), 3: () => guide(3), t: () => $("theme").click(),
};

function startKeys() {
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("select, input, button, a, summary, textarea")) return;
    const onMap = event.target.closest("#x-map");
    const act = onMap && DRIVES[event.key] ? () => drive(DRIVES[event.key]) : onMap && event.key === "Enter" ? () => $("x-again").click() : KEYS[event.key];
    if (!act) return;
    event.preventDefault(); // neither space nor arrows shall scroll
    act();
  });
}
