/* Distance maps: the value under the cursor, in millimetres, from any of the focal points. */
(() => {
  const canvas = byId("map");
  if (!canvas) return;
  const value = byId("map-value"), where = byId("map-place"), context = canvas.getContext("2d");
  let map = null, cursor = null, picture = null;

  /** World place of pixel (u, v) at `distance` along its ray. */
  const placeOf = (u, v, distance) => {
    if (!map.intrinsics) return null;
    const [fx, fy, cx, cy] = map.intrinsics, ray = [(u - cx) / fx, (v - cy) / fy, 1], scale = distance / Math.hypot(...ray);
    return [0, 1, 2].map((k) => map.pose[k][3] + scale * (map.pose[k][0] * ray[0] + map.pose[k][1] * ray[1] + map.pose[k][2] * ray[2]));
  };
  const here = () => (cursor ? map.values[cursor[1] * map.width + cursor[0]] : NaN);
  const redraw = () => {
    context.putImageData(picture, 0, 0);
    if (!cursor) return;
    const [u, v] = cursor, arm = Math.max(5, map.width / 40);
    for (const [colour, width] of [["rgba(0,0,0,.75)", 3], ["#fff", 1.2]]) {
      context.strokeStyle = colour; context.lineWidth = (width * map.width) / 512;
      context.beginPath();
      context.moveTo(u - arm, v + 0.5); context.lineTo(u + arm + 1, v + 0.5); context.moveTo(u + 0.5, v - arm); context.lineTo(u + 0.5, v + arm + 1);
      context.stroke();
    }
  };
  const tellValue = () => {
    redraw();
    const distance = here();
    canvas.dataset.pixel = cursor ? cursor.join(",") : "";
    if (!cursor) { value.textContent = "–"; where.textContent = "Point at the map to measure."; return; }
    value.textContent = Number.isNaN(distance) ? "nothing" : `${distance.toFixed(2)} mm`;
    const place = Number.isNaN(distance) ? null : placeOf(cursor[0], cursor[1], distance);
    where.textContent = `column ${cursor[0]}, row ${cursor[1]}${place ? `: ${point(place)}` : ""}`;
  };
  const choose = async (index) => {
    const next = data.maps[index];
    next.values ||= await unpackedFloats(next.distance);
    map = next;
    canvas.width = map.width; canvas.height = map.height;
    let low = Infinity, high = -Infinity;
    for (const x of map.values) if (x < low) low = x; else if (x > high) high = x;
    if (!(low <= high)) { low = Math.min(low, 0); high = low + 1; }
    picture = context.createImageData(map.width, map.height);
    map.values.forEach((x, i) => { if (!Number.isNaN(x)) picture.data.set([...colourAt("viridis", 1 - (x - low) / (high - low || 1)), 255], 4 * i); });
    const eye = map.pose.slice(0, 3).map((row) => row[3]);
    byId("map-legend").replaceChildren();
    drawScale(byId("map-legend"), "viridis", high, low, "mm", `Focal point at ${point(eye)}. ${map.width} × ${map.height} pixels, in steps of ${short(map.distance.step)} mm.`);
    if (cursor) cursor = [Math.min(cursor[0], map.width - 1), Math.min(cursor[1], map.height - 1)];
    canvas.dataset.map = String(index);
    tellValue();
  };
  canvas.addEventListener("pointermove", (e) => {
    if (!map) return;
    // the picture keeps its shape inside the canvas' box
    const box = canvas.getBoundingClientRect(), scale = Math.min(box.width / map.width, box.height / map.height);
    const u = Math.floor((e.clientX - box.left - (box.width - scale * map.width) / 2) / scale), v = Math.floor((e.clientY - box.top - (box.height - scale * map.height) / 2) / scale);
    if (u < 0 || v < 0 || u >= map.width || v >= map.height) return;
    cursor = [u, v];
    tellValue();
  });
  const mark = () => { const distance = here(), place = Number.isNaN(distance) ? null : placeOf(cursor[0], cursor[1], distance); if (place && data.model) tell("place", place); };
  canvas.addEventListener("click", mark);
  canvas.addEventListener("keydown", (e) => {
    const arrow = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[e.key];
    if (!map) return;
    if (arrow) {
      const by = e.shiftKey ? 10 : 1, from = cursor || [map.width >> 1, map.height >> 1];
      cursor = [Math.max(0, Math.min(map.width - 1, from[0] + by * arrow[0])), Math.max(0, Math.min(map.height - 1, from[1] + by * arrow[1]))];
      tellValue();
    } else if (e.key === "Enter") mark();
    else return;
    e.preventDefault();
  });
  for (const radio of document.querySelectorAll('input[name="focal"]')) radio.addEventListener("change", () => choose(Number(radio.value)));
  choose(0);
})();
