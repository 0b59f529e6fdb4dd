// Puts the page together.

function setTheme(name) {
  document.documentElement.dataset.theme = name;
  $("theme").textContent = name === "dark" ? "Light" : "Dark";
  for (const draw of redraws) draw();
}

function introduce() {
  const strong = (text) => make("strong", {}, text);
  const scenes = Object.values(DATA.scenes), states = scenes.reduce((sum, scene) => sum + scene.states, 0);
  const runs = DATA.tables.runs.length;
  $("lede").replaceChildren(
    strong(plural(DATA.models.length, "model")), " in ", strong(plural(runs, "run")), ", in ", strong(plural(scenes.length, "scene")), " of ",
    strong(`${grouped(states)} poses`), ": each agent is shown a picture of its goal, and moves towards it by what it sees.",
  );
  const { vusfa, torch, python } = DATA.versions;
  const places = [...new Set(DATA.tables.runs.map((row) => row.scenes))];
  const said = [places.length === 1 && places[0] ? `All runs are in: ${places[0]}. ` : "", `Made by vusfa ${vusfa} with PyTorch ${torch} and Python ${python}`, DATA.command ? `, with: ${DATA.command}` : "", "."];
  said.push(" To keep the page small, pictures are scaled down");
  if (DATA.agents.length) {
    const every = Object.keys(DATA.agents[0].scenes).every((name) => DATA.goals[name].length === DATA.scenes[name].states);
    said.push(", values and components of ψ are rounded to 255 levels", every ? "; the explorer has every state as a goal" : `, and the explorer has at most ${DATA.goals_limit} goals per scene`);
    if (!every && DATA.goals_limit < DATA.goals_asked) said.push(` (of ${DATA.goals_asked}; more megabytes give more)`);
  }
  said.push(".");
  const pictures = scenes.reduce((sum, scene) => sum + scene.pictures.ids.length, 0);
  if (pictures && pictures < states) said.push(` It has pictures of ${grouped(pictures)} of the ${grouped(states)} poses.`);
  said.push(" The tables are beside this page as CSV, unrounded.", ...DATA.notes.map((note) => ` ${note}`));
  $("about").textContent = said.join("");
}

function watchSections() {
  const links = [...document.querySelectorAll(".bar a")];
  for (const link of links) link.hidden = document.querySelector(link.hash).hidden;
  const watcher = new IntersectionObserver((entries) => {
    for (const entry of entries) if (entry.isIntersecting) links.forEach((link) => link.classList.toggle("here", link.hash === `#${entry.target.id}`));
  }, { rootMargin: "-20% 0px -70% 0px" });
  document.querySelectorAll("main section").forEach((section) => watcher.observe(section));
}

introduce();
document.documentElement.dataset.theme = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
startCharts();
startMaps();
startExplorer();
watchSections();
$("theme").addEventListener("click", () => setTheme(theme() === "dark" ? "light" : "dark"));
setTheme(theme());
if (DATA.agents.length) readLink();
document.documentElement.dataset.ready = "yes";
