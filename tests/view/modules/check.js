// What a test of a module needs: `test`, and checks that say what they saw.

const tests = new Map();

export function test(sentence, body) {
  if (tests.has(sentence)) throw new Error(`two tests are called "${sentence}"`);
  tests.set(sentence, body);
}

export async function run(sentence) {
  await tests.get(sentence)();
}

export function ok(condition, message = "") {
  if (!condition) throw new Error(`not so: ${message}`);
}

export function equal(actual, expected) {
  const [a, b] = [JSON.stringify(actual), JSON.stringify(expected)];
  if (a !== b) throw new Error(`is ${a}, not ${b}`);
}

export function near(actual, expected, within = 1e-9) {
  if (!(Math.abs(actual - expected) <= within)) {
    throw new Error(`is ${actual}, not ${expected} within ${within}`);
  }
}
