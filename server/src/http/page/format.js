// Numbers as people read them.

const WHOLE = new Intl.NumberFormat("en-US", { maximumFractionDigits: 0 });

/** A count: 1,234,567. */
export function count(number) {
  return WHOLE.format(number);
}

/** An estimate in two digits: about 2,300. */
export function about(number) {
  return `about ${count(Number(number.toPrecision(2)))}`;
}

/** A count with its noun: "1 point", "2 points". */
export function counted(number, noun) {
  return `${count(number)} ${noun}${Number(number) === 1 ? "" : "s"}`;
}

/** A count in at most four characters: 12.3k, 4.56M. */
export function short(number) {
  if (number < 10_000) return count(number);
  if (number < 1_000_000) return `${digits(number / 1e3)}k`;
  return `${digits(number / 1e6)}M`;
}

/** A rate: 0, 0.35, 12, 1,234. */
export function rate(number) {
  if (number === 0) return "0";
  if (number < 0) return `-${rate(-number)}`;
  if (number < 0.01) return "<0.01";
  return number < 100 ? digits(number) : count(number);
}

/** Bytes in binary units: 12.5 MiB. */
export function bytes(number) {
  const units = ["B", "KiB", "MiB", "GiB", "TiB"];
  let unit = 0;
  while (number >= 1024 && unit < units.length - 1) {
    number /= 1024;
    unit += 1;
  }
  return `${unit === 0 ? count(number) : digits(number)} ${units[unit]}`;
}

/** A time of seconds: 0.25 ms, 12 ms, 1.2 s. An upper bound that is infinite has no number. */
export function duration(seconds) {
  if (seconds === null) return "–";
  if (!Number.isFinite(seconds)) return "very long";
  if (seconds < 1e-3) return `${digits(seconds * 1e6)} µs`;
  if (seconds < 1) return `${digits(seconds * 1e3)} ms`;
  return `${digits(seconds)} s`;
}

/** Three significant digits without zeros at the end. */
export function digits(number) {
  if (number === 0) return "0";
  return Math.abs(number) >= 1000 ? count(number) : String(Number(number.toPrecision(3)));
}

/** A name in at most `most` characters. Names of one planner begin alike, so it is the middle that is left out. */
export function shortened(name, most) {
  if (name.length <= most) return name;
  const start = Math.floor((most - 1) / 3);
  return `${name.slice(0, start)}…${name.slice(start + 1 - most)}`;
}
