'use strict';
const $ = (name) => document.getElementById(name);
const KINDS = {1: 'camera', 2: 'goal', 3: 'map'};
const LEVELS = ['ok', 'warn', 'error', 'error'];
const OLD_MS = 3000;  // without word from the server
const ANSWER_MS = 8000;  // for an answer; the server itself waits 3 s for the policy
let waiting = 0, heard = 0, curve = [], ofGoal = null, bag = null, received = [], places = '';

function say(text, good) {
  $('said').textContent = text;
  $('said').classList.toggle('good', Boolean(good));
}

// While an answer is waited for nothing but a stop can be asked.
function wait(more) {
  waiting += more;
  document.querySelectorAll('button:not(#stop), #file').forEach(
    (one) => { one.disabled = waiting > 0; });
  if (!waiting) sendFile();
}

// A file that is chosen while an answer is waited for is sent after it.
function sendFile() {
  const [file] = $('file').files;
  if (!file || waiting) return;
  $('file').value = '';
  ask('goal', file);
}

async function ask(address, body) {
  const stops = address === 'stop';
  if (!stops && waiting) return;
  if (!stops) { $('stop').focus(); wait(1); }  // a disabled button would keep the space bar
  try {
    const signal = address === 'goal' ? undefined : AbortSignal.timeout(ANSWER_MS);
    const answer = await fetch(address, {method: 'POST', body, signal});
    const said = answer.ok ? await answer.json() : {done: false, message: await answer.text()};
    say(said.message, said.done);
  } catch (error) {
    say(`The dashboard does not answer (${error.message}): use the robot's own stop.`);
  } finally {
    if (!stops) wait(-1);
  }
}

function stop(event) {
  if (event) event.preventDefault();
  say('Stop asked for ...');
  ask('stop');
}

function show(kind, blob) {
  const image = $(KINDS[kind]), before = image.src;
  image.src = URL.createObjectURL(blob);
  image.hidden = false;
  image.onload = () => { if (before) URL.revokeObjectURL(before); };
  if (kind === 1) {
    const now = performance.now();
    received = [...received.filter((at) => now - at < 3000), now];
  }
}

function draw() {
  const last = Math.max(curve.length - 1, 1);
  document.querySelector('#curve path').setAttribute('d', curve.map(
    (p, k) => `${k ? 'L' : 'M'}${(400 * k) / last},${195 - 190 * p}`).join(''));
}

function tell(state) {
  $('state').textContent = state.state;
  $('reason').textContent = state.message;
  $('light').className = LEVELS[state.level] || '';
  $('reset').hidden = state.state !== 'stopped';
  const goal = state.goal;
  if (goal.number !== ofGoal) { ofGoal = goal.number; curve = []; }
  $('goal_status').textContent = goal.status +
    (goal.error_msg ? `: ${goal.error_msg}` : '');
  if (goal.arrival !== null && goal.decisions > curve.length) {
    while (curve.length < goal.decisions - 1) curve.push(curve.length ? curve.at(-1) : 0);
    curve.push(goal.arrival);
  }
  draw();
  $('arrival').textContent = goal.arrival === null ? '' : goal.arrival.toFixed(2);
  $('distance').textContent = goal.distance === null ? '' : `goal ${goal.distance.toFixed(1)} m away`;
  tellRoute(state.route);
  $('values').replaceChildren(...Object.entries(state.values).flatMap(([name, value]) => {
    const [dt, dd] = ['dt', 'dd'].map((tag) => document.createElement(tag));
    dt.textContent = name;
    dd.textContent = value;
    return [dt, dd];
  }));
}

function tellRoute(route) {
  $('route').hidden = !route;
  if (!route) { places = ''; return; }
  const names = Object.keys(route.places), drives = ['locating', 'active'].includes(route.status);
  if (JSON.stringify(names) !== places) {
    places = JSON.stringify(names);
    const none = document.createElement('p');
    none.className = 'empty';
    none.textContent = 'No place has a name: vn_nav route FOLDER --name kitchen=12';
    $('places').replaceChildren(...names.length ? names.map((name) => {
      const button = document.createElement('button');
      button.textContent = name;
      button.disabled = waiting > 0;
      button.addEventListener('click', () => ask('place', name));
      return button;
    }) : [none]);
  }
  [...$('places').children].forEach((button) => button.classList.toggle(
    'chosen', drives && button.textContent === route.place));
  const to = route.place ? `to ${route.place}` : '';
  $('route_status').textContent = [
    {none: '', locating: `${to}: looks where it is`, active: `drives ${to}`,
      succeeded: `arrived at ${route.place}`, failed: `${to} failed`,
      cancelled: `${to} cancelled`}[route.status],
    route.error_msg,
    drives && route.shown !== null ? `shows picture ${route.shown}` : '',
    route.here !== null ? `nearest: ${route.here}` : ''].filter(Boolean).join('; ');
}

function connect() {
  const socket = new WebSocket(`${location.protocol === 'https:' ? 'wss' : 'ws'}://${location.host}/live`);
  socket.binaryType = 'arraybuffer';
  socket.onmessage = ({data}) => {
    heard = performance.now();
    if (typeof data === 'string') { tell(JSON.parse(data)); return; }
    const kind = new Uint8Array(data)[0];
    show(kind, new Blob([data.slice(1)], {type: kind === 3 ? 'image/png' : 'image/jpeg'}));
  };
  socket.onclose = () => setTimeout(connect, 1000);
}

function watch() {
  const now = performance.now();
  received = received.filter((at) => now - at < 3000);
  $('rate').textContent = received.length > 1 ? `${(received.length / 3).toFixed(1)} a second` : '';
  if (heard && now - heard > OLD_MS) {
    $('state').textContent = 'not connected';
    $('reason').textContent = 'the dashboard is silent: what is shown is old';
    $('light').className = 'error';
  }
}

function choose(number) {
  if (waiting) return;
  document.querySelectorAll('.chosen').forEach((node) => node.classList.remove('chosen'));
  $('pictures').children[number].classList.add('chosen');
  $('pictures').children[number].scrollIntoView({block: 'nearest'});
  $('path').querySelectorAll('path')[number].classList.add('chosen');
  ask(`goal/${number}`);
}

function showBag() {
  const svg = $('path'), xs = bag.path.map((p) => p[0]), ys = bag.path.map((p) => -p[1]);
  const [x0, x1, y0, y1] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const margin = 0.8;
  svg.setAttribute('viewBox', `${x0 - margin} ${y0 - margin} ${x1 - x0 + 2 * margin} ${y1 - y0 + 2 * margin}`);
  const size = 0.035 * Math.max(x1 - x0, y1 - y0, 4);
  const make = (tag, attributes) => {
    const node = document.createElementNS('http://www.w3.org/2000/svg', tag);
    Object.entries(attributes).forEach(([name, value]) => node.setAttribute(name, value));
    return node;
  };
  svg.append(make('polyline', {points: bag.path.map((p) => `${p[0]},${-p[1]}`).join(' ')}));
  bag.poses.forEach(([x, y, yaw]) => svg.append(make('path', {
    d: `M${size},0 L${-0.6 * size},${0.6 * size} L${-0.6 * size},${-0.6 * size}Z`,
    transform: `translate(${x} ${-y}) rotate(${(-180 * yaw) / Math.PI})`})));
  svg.addEventListener('click', (event) => {
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    const away = bag.poses.map(([x, y]) => Math.hypot(x - at.x, -y - at.y));
    choose(away.indexOf(Math.min(...away)));
  });
  bag.poses.forEach((_, number) => {
    const button = document.createElement('button'), image = document.createElement('img');
    image.src = `bag/${number}.jpg`;
    image.loading = 'lazy';
    image.alt = `picture ${number + 1}`;
    button.append(image);
    button.addEventListener('click', () => choose(number));
    $('pictures').append(button);
  });
  $('bag_name').textContent = bag.name;
  $('bag').hidden = false;
}

$('stop').addEventListener('click', stop);
$('enable').addEventListener('click', () => ask('enable'));
$('reset').addEventListener('click', () => ask('reset'));
$('file').addEventListener('change', sendFile);
// Whatever has the focus: the space bar must not press Enable again.
document.addEventListener('keydown', (event) => {
  if ((event.key === 'Escape' || event.key === ' ') && !event.repeat) stop(event);
  else if (event.key === ' ') event.preventDefault();
}, true);
document.addEventListener('keyup', (event) => {
  if (event.key === ' ') event.preventDefault();
}, true);
setInterval(watch, 500);
connect();
fetch('bag').then((answer) => answer.json()).then((found) => {
  bag = found;
  if (bag) showBag();
});
