// What follows from a policy that depends on the pose alone: its episodes towards a goal are a Markov chain on the scene's graph.

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

// h_k(s) = sum_a pi(a | s) h_{k-1}(next(s, a)), 1 at the goal: the probability of arriving within k actions, see markov.py.
function arrival({ next }, shares, width, goal, steps) {
  const count = next.length / width;
  let now = new Float64Array(count), before = new Float64Array(count);
  now[goal] = 1;
  for (let step = 0; step < steps; step++) {
    [now, before] = [before, now];
    for (let state = 0, at = 0; state < count; state++) {
      let sum = 0;
      for (let action = 0; action < width; action++, at++) sum += shares[at] * before[next[at]];
      now[state] = sum;
    }
    now[goal] = 1;
  }
  return now;
}

// sum_t gamma^t P(s_t = s | s_0 = start) up to the goal: row `start` of the successor representation (Dayan 1993).
function occupancy({ next }, shares, width, start, goal, gamma, steps) {
  const count = next.length / width, total = new Float64Array(count);
  let now = new Float64Array(count), after = new Float64Array(count), weight = 1;
  now[start] = 1;
  for (let step = 0; step <= steps && weight > 1e-6; step++, weight *= gamma) {
    after.fill(0);
    for (let state = 0; state < count; state++) {
      const mass = now[state];
      if (!mass) continue;
      total[state] += weight * mass;
      if (state === goal) continue;
      for (let action = 0, at = state * width; action < width; action++, at++) after[next[at]] += mass * shares[at];
    }
    [now, after] = [after, now];
  }
  return total;
}

// The mean over all starts that can reach the goal, as everywhere on the page.
function meanOverStarts(values, togo) {
  let sum = 0, count = 0;
  for (let state = 0; state < togo.length; state++) if (togo[state] > 0) { sum += values[state]; count += 1; }
  return count ? sum / count : NaN;
}

// Random numbers of a seed (mulberry32), so that a page shows the same episodes whenever it is opened.
function randoms(seed) {
  let state = seed >>> 0;
  return () => {
    state = (state + 0x6d2b79f5) >>> 0;
    let mixed = Math.imul(state ^ (state >>> 15), state | 1);
    mixed ^= mixed + Math.imul(mixed ^ (mixed >>> 7), mixed | 61);
    return ((mixed ^ (mixed >>> 14)) >>> 0) / 4294967296;
  };
}

function sampleWalk({ next }, shares, width, start, goal, steps, seed) {
  const random = randoms(Math.imul(seed + 1, 2654435761) ^ Math.imul(start, 40503) ^ goal), way = [start];
  for (let state = start; state !== goal && way.length <= steps; ) {
    let draw = random(), action = 0;
    while (action < width - 1 && (draw -= shares[state * width + action]) >= 0) action += 1;
    way.push((state = next[state * width + action]));
  }
  return way;
}

function likeliest(shares, state, width) {
  let best = 0;
  for (let action = 1; action < width; action++) if (shares[state * width + action] > shares[state * width + best]) best = action;
  return best;
}
