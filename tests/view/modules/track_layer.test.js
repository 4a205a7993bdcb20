import { TrackLayer } from "/static/js/track_layer.js";
import { Track } from "/static/js/tracks.js";
import { toScreen } from "/static/js/transform.js";
import { equal, ok, test } from "./check.js";

const VIEW = { x: 0, y: 0, scale: 20, rotation: 0, width: 400, height: 300 };

function stage() {
  const canvas = document.createElement("canvas");
  canvas.width = 400;
  canvas.height = 300;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  const track = new Track();
  track.add(0, -5, 1);
  track.add(4, 5, 1);
  const layer = new TrackLayer();
  const draw = (view) => {
    context.clearRect(0, 0, 400, 300);
    return layer.draw(context, view, 1, [[1, track, "#ff0000"]], 4);
  };
  const red = (view, x, y) => {
    const [px, py] = toScreen(view, x, y);
    return context.getImageData(Math.round(px), Math.round(py), 1, 1).data[3] > 128;
  };
  return { track, layer, draw, red };
}

test("a track lies where it was walked, however the map is turned and moved", () => {
  const { layer, draw, red } = stage();
  for (const view of [VIEW, { ...VIEW, rotation: 1 }, { ...VIEW, x: 1, y: -1, rotation: -2 }]) {
    draw(view);
    for (const x of [-4, 0, 4]) {
      ok(red(view, x, 1), `${x} ${view.rotation}`);
      ok(!red(view, x, 2), `${x} ${view.rotation}`);
    }
  }
  equal(layer.renderings, 1);
});

test("a new step is added to what is drawn", () => {
  const { track, layer, draw, red } = stage();
  draw(VIEW);
  track.add(6, 5, 5);
  draw(VIEW);
  ok(red(VIEW, 5, 3));
  equal(layer.renderings, 1);
});

test("a step that starts anew leaves a gap", () => {
  const { track, draw, red } = stage();
  track.add(5, -5, -5);
  track.add(9, 5, -5);
  draw(VIEW);
  ok(red(VIEW, 0, -5));
  ok(!red(VIEW, 0, -2));
});

test("a track that was restored is drawn anew", () => {
  const { track, draw, red } = stage();
  draw(VIEW);
  track.restore([[0, -5, -3], [4, 5, -3]]);
  draw(VIEW);
  ok(red(VIEW, 0, -3));
  ok(!red(VIEW, 0, 1));
});

test("another scale is stretched at first and sharp soon after", async () => {
  const { layer, draw, red } = stage();
  draw(VIEW);
  const near = { ...VIEW, scale: 30 };
  equal(draw(near), true);
  ok(red(near, 3, 1));
  equal(layer.renderings, 1);
  await new Promise((resolve) => setTimeout(resolve, 200));
  equal(draw(near), false);
  equal(layer.renderings, 2);
  ok(red(near, 3, 1));
});

test("beyond what was drawn it is drawn anew", () => {
  const { layer, draw } = stage();
  draw(VIEW);
  draw({ ...VIEW, x: 40 });
  equal(layer.renderings, 2);
});
