// The page of the live map: draws tiles once, then colours what changes.
const words = JSON.parse(document.body.dataset.words);
const colours = JSON.parse(document.body.dataset.colours);
const language = document.documentElement.lang;
const tenths = new Intl.NumberFormat(language, { minimumFractionDigits: 1, maximumFractionDigits: 1 });
const hundredths = new Intl.NumberFormat(language, { minimumFractionDigits: 2, maximumFractionDigits: 2 });
const figure = new Intl.NumberFormat(language, { maximumFractionDigits: 2 });
const byId = (name) => document.getElementById(name);
const SPOKEN_MS = 15000; // a screen reader is told the summary: not more often
const CLOSE = 17.5; // zoom from which vehicles are large enough for an outline
const VEHICLES_MS = 900; // between two drawings of vehicles: a phone takes its time for each
const NEAR = 14; // zoom from which tiles are drawn, not lanes: a tile is a twentieth of a pixel there
const RETRY_MS = 5000;
const SILENT_MS = 5000; // without an event the connection counts as broken

const state = { hit: new Set(), unobserved: new Set(), classes: {}, lanes: {}, sensors: {}, occupancy: {}, traffic: {} };
let vehicles = null, drawnVehicles = "", drawnAt = 0;
let site, map, last = Date.now(), spoken = 0, opened = 0;

function problem(each) {
  return Object.entries(each.alarms).map(([kind, told]) => `${words.alarms[kind]}: ${told[language]}`).join("; ");
}

function take(event) {
  last = Date.now();
  if (event.whole && event.tiles !== site.fingerprint) {
    location.reload(); // fusion was started anew with other tiles
    return;
  }
  const touched = new Set();
  for (const name of ["hit", "unobserved"]) {
    const on = event.whole ? event[name] : event[name].on;
    const off = event.whole ? [...state[name]] : event[name].off;
    for (const tile of off) { state[name].delete(tile); touched.add(tile); }
    for (const tile of on) { state[name].add(tile); touched.add(tile); }
  }
  for (const name of ["classes", "lanes", "sensors", "occupancy", "traffic"]) {
    if (event.whole) state[name] = {};
    Object.assign(state[name], event[name]);
  }
  for (const tile of [...Object.keys(event.classes), ...Object.keys(event.occupancy)]) touched.add(Number(tile));
  byId("unmeasured")?.toggleAttribute("hidden", Object.keys(state.traffic).length > 0);
  vehicles = event.vehicles;
  showVehicles();
  byId("clock").textContent = event.clock;
  colour(touched);
  if (Object.keys(event.sensors).length) showSensors();
  if (Object.keys(event.lanes).length || Object.keys(event.traffic).length) showLanes();
  colourLanes(event.lanes, event.traffic);
  summarise();
}

function summarise() {
  const sensors = Object.entries(state.sensors).map(
    ([name, each]) => `${name}: ${problem(each) || (each.online ? words.online : words.offline)}`);
  const heavy = (vehicles ?? []).filter((each) => each[7]).length;
  const now = vehicles === null ? [] :
    [words.vehicles.replace("{n}", figure.format(vehicles.length)).replace("{heavy}", figure.format(heavy))];
  const text = [...now, words.hit.replace("{n}", figure.format(state.hit.size)), ...sensors].join(". ") + ".";
  byId("summary").textContent = text;
  if (Date.now() - spoken < SPOKEN_MS) return;
  spoken = Date.now();
  byId("spoken").textContent = text;
}

function colour(tiles) {
  if (!map) return;
  for (const id of tiles) {
    map.setFeatureState({ source: "tiles", id }, {
      hit: state.hit.has(id), unobserved: state.unobserved.has(id), level: state.classes[id] ?? -1,
      occupancy: state.occupancy[id] ?? -1,
    });
  }
}

function levelOf(share) {
  return share === null ? -1 : colours.breaks.filter((each) => share > each).length;
}

function colourLanes(lanes, traffic) {
  if (!map) return;
  const paint = (id, look) => map.setFeatureState({ source: "lanes", id: Number(id) }, look);
  for (const [id, share] of Object.entries(lanes)) paint(id, { level: levelOf(share) });
  for (const [id, [share]] of Object.entries(traffic)) paint(id, { occupancy: levelOf(share) });
}

function chosen() {
  return document.querySelector("input[name=measure]:checked").value;
}

function explain() { // zoomed out there are lanes in place of tiles, of which there is no now
  const far = map && map.getZoom() < NEAR, measure = chosen();
  byId("side").dataset.measure = measure === "now" && far ? "now-far" : measure;
}

function show() {
  const measure = chosen();
  explain();
  if (!map) return;
  map.setPaintProperty("tiles", "fill-color", paints[measure]);
  map.setPaintProperty("lanes", "line-color", measure === "occupancy" ? occupancy : lately);
}

function row(cells, numbers) {
  const line = document.createElement("tr");
  cells.forEach((text, place) => {
    const cell = document.createElement(place ? "td" : "th");
    if (!place) cell.scope = "row";
    cell.textContent = text;
    if (numbers.includes(place)) cell.className = "n";
    line.append(cell);
  });
  return line;
}

function showSensors() {
  const lines = Object.entries(state.sensors).map(([name, each]) => {
    const lag = each.lag_s === null ? "–" : hundredths.format(each.lag_s);
    const said = problem(each) || (each.online ? words.online : words.offline);
    const line = row([name, said, tenths.format(each.frames_per_s), lag, figure.format(each.lost)], [2, 3, 4]);
    if (problem(each) || !each.online) line.children[1].classList.add("bad");
    return line;
  });
  byId("sensor-rows").replaceChildren(...lines);
  if (map?.getSource("sensors")) map.getSource("sensors").setData(sensorLayer());
}

function showLanes() {
  const known = Object.entries(state.lanes).map(([place, share]) => [site.lanes[place], share, place]);
  known.sort(([, one], [, other]) => (other ?? -1) - (one ?? -1));
  const percent = (share) => share === null ? "–" : `${tenths.format(share / 10)} %`;
  const lines = known.map(([lane, share, place]) => {
    const [occupancy, volume, counted, speed, queue] = state.traffic[place] ?? [null, null, null, null, null];
    const number = (value) => value === null ? "–" : figure.format(value);
    const passed = volume === null && counted ? `≥ ${figure.format(counted)}` : number(volume);
    const more = vehicles === null ? [] : [percent(occupancy), passed, number(speed), number(queue)];
    const line = row([lane.name, percent(share), ...more], [1, 2, 3, 4, 5]);
    line.title = lane.number;
    return line;
  });
  byId("lane-rows").replaceChildren(...lines);
}

function showVehicles() {
  const text = JSON.stringify(vehicles);
  if (!map?.getSource("vehicles") || text === drawnVehicles || Date.now() - drawnAt < VEHICLES_MS) return;
  drawnVehicles = text;
  drawnAt = Date.now();
  map.getSource("vehicles").setData(vehicleLayer());
}

function vehicleLayer() {
  const features = (vehicles ?? []).map(([id, west, south, east, north, width, speed, heavy]) => {
    const metre = 1 / 111320, flat = Math.cos((south * Math.PI) / 180);
    const [x, y] = [(east - west) * flat, north - south], long = Math.hypot(x, y) || 1;
    const [dx, dy] = [(-y / long) * (width / 2) * metre / flat, (x / long) * (width / 2) * metre];
    const ring = [[west + dx, south + dy], [east + dx, north + dy], [east - dx, north - dy], [west - dx, south - dy]];
    return { type: "Feature", properties: { id, speed, heavy }, geometry: { type: "Polygon", coordinates: [[...ring, ring[0]]] } };
  });
  return { type: "FeatureCollection", features };
}

function sensorLayer() {
  const features = [];
  for (const [name, each] of Object.entries(state.sensors)) {
    if (!each.at) continue;
    const properties = { name, online: each.online && !problem(each) };
    features.push({ type: "Feature", properties, geometry: { type: "Polygon", coordinates: [each.view] } });
    features.push({ type: "Feature", properties, geometry: { type: "Point", coordinates: each.at } });
  }
  return { type: "FeatureCollection", features };
}

const lately = ["match", ["feature-state", "level"],
  ...colours.classes.flatMap((each, place) => [place, each]), colours.unobserved];
const occupancy = ["match", ["feature-state", "occupancy"],
  ...colours.classes.flatMap((each, place) => [place, each]), colours.unobserved];
const paints = {
  occupancy,
  lately: ["case", ["boolean", ["feature-state", "hit"], false], colours.hit, lately],
  now: ["case", ["boolean", ["feature-state", "hit"], false], colours.hit,
    ["boolean", ["feature-state", "unobserved"], false], colours.unobserved, colours.free],
};

async function draw() {
  const maplibre = await import("/web/vendor/maplibre-gl.mjs").catch(() => { throw words.no_library; });
  const shown = new maplibre.Map({
    container: "map", bounds: site.bounds, fitBoundsOptions: { padding: 30 }, attributionControl: false,
    style: { version: 8, sources: {}, layers: [] }, dragRotate: false, pitchWithRotate: false,
  });
  shown.addControl(new maplibre.NavigationControl({ showCompass: false }));
  shown.addControl(new maplibre.ScaleControl());
  await shown.once("load");
  shown.addSource("tiles", { type: "geojson", data: site.tiles, tolerance: 0, maxzoom: 20 });
  shown.addSource("lanes", { type: "geojson", data: site.lines });
  shown.addSource("sensors", { type: "geojson", data: sensorLayer() });
  shown.addLayer({ id: "lanes", type: "line", source: "lanes", maxzoom: NEAR,
    paint: { "line-color": lately, "line-width": 3 } });
  shown.addLayer({ id: "tiles", type: "fill", source: "tiles", minzoom: NEAR,
    paint: { "fill-color": paints.lately, "fill-antialias": false } });
  shown.addSource("vehicles", { type: "geojson", data: vehicleLayer(), tolerance: 0, maxzoom: 20 });
  // a white rim sets vehicles off from every colour of the tiles, for eyes that see no green, too
  shown.addLayer({ id: "rims", type: "line", source: "vehicles",
    paint: { "line-color": "#fff", "line-width": ["step", ["zoom"], 5, CLOSE, 4] } });
  shown.addLayer({ id: "vehicles", type: "fill", source: "vehicles", paint: { "fill-color": colours.vehicle } });
  shown.addLayer({ id: "outlines", type: "line", source: "vehicles", maxzoom: CLOSE, // so that small ones are seen
    paint: { "line-color": colours.vehicle, "line-width": 2 } });
  shown.addLayer({ id: "edges", type: "line", source: "vehicles", minzoom: CLOSE,
    paint: { "line-color": "#1d2126", "line-width": 1 } });
  const healthy = ["case", ["get", "online"], "#1d2126", "#9c1c1c"];
  shown.addLayer({ id: "views", type: "line", source: "sensors", filter: ["==", ["geometry-type"], "Polygon"],
    paint: { "line-color": healthy, "line-width": ["case", ["get", "online"], 1, 2.5], "line-dasharray": [4, 3] } });
  shown.addLayer({ id: "masts", type: "circle", source: "sensors", filter: ["==", ["geometry-type"], "Point"],
    paint: { // one with a fault is a ring
      "circle-color": ["case", ["get", "online"], "#1d2126", "#fff"], "circle-radius": 6,
      "circle-stroke-color": ["case", ["get", "online"], "#fff", "#9c1c1c"],
      "circle-stroke-width": ["case", ["get", "online"], 2, 4] } });
  map = shown;
  colour(new Set(Object.keys(state.classes).map(Number)));
  colourLanes(state.lanes, state.traffic);
  map.on("zoom", explain);
  show();
  document.body.dataset.drawn = "true";
}

function trouble(text) {
  byId("trouble").hidden = !text;
  byId("trouble").textContent = text;
}

function listen() {
  opened = Date.now();
  const stream = new EventSource("/events");
  stream.addEventListener("map", (event) => take(JSON.parse(event.data)));
  return stream;
}

async function begin() {
  for (const choice of document.querySelectorAll("input[name=measure]")) choice.addEventListener("change", show);
  show();
  site = await (await fetch(`/site.json?lang=${language}`)).json();
  let stream = listen();
  let undrawn = "";
  setInterval(() => {
    const silent = Date.now() - last > SILENT_MS;
    // after an answer that is no stream, as of a proxy, a browser does not try again by itself
    if (stream.readyState === EventSource.CLOSED && Date.now() - opened > RETRY_MS) stream = listen();
    trouble(silent ? words.late : undrawn);
    document.body.classList.toggle("silent", silent);
  }, 1000);
  try { await draw(); } catch (why) {
    undrawn = why === words.no_library ? why : words.no_map;
    byId("map").parentElement.hidden = true;  // with its legend
    trouble(undrawn);
  }
}

begin();
