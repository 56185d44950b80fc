// The round numbers along an axis, and their texts.

const FACTORS = [1, 2, 5, 10];

/** About `wanted` round numbers within a range: `at`, and the `text` with the digits that tell it from its neighbours. */
export function ticksOf([low, high], wanted = 6) {
  const rough = (high - low) / wanted;
  if (!(rough > 0) || !Number.isFinite(rough)) return [];
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * FACTORS.find((factor) => factor * power >= rough * 0.99);
  const ticks = [];
  // Where numbers are so large that a step changes nothing, the loop ends by the count.
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step && ticks.length < 4 * wanted; i++) {
    ticks.push({ at: i * step, text: textOf(i * step, step) });
  }
  return ticks;
}

function textOf(number, step) {
  if (Math.abs(number) < step / 2) return "0";
  const ofStep = exponent(step);
  if (Math.abs(number) >= 1e7 || step < 1e-6) return number.toExponential(Math.min(Math.max(exponent(number) - ofStep, 0), 20));
  const [whole, decimals] = number.toFixed(Math.max(0, -ofStep)).split(".");
  const grouped = Math.abs(number) >= 10_000 ? whole.replace(/\B(?=(\d{3})+$)/g, ",") : whole;
  return decimals === undefined ? grouped : `${grouped}.${decimals}`;
}

function exponent(number) {
  return Math.floor(Math.log10(Math.abs(number)) + 1e-9);
}
