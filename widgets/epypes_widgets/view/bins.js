// Where do the bars and the thresholds of a histogram stand?

/** @typedef {{low: number, high: number, bins: number, channels: {name: string, counts: number[]}[]}} Histogram */

/** Return the share of the width at which a value stands, kept within 0 and 1. */
export function shareOf(histogram, value) {
  const span = histogram.high - histogram.low;
  return span > 0 ? Math.min(1, Math.max(0, (value - histogram.low) / span)) : 0.5;
}

/** Return the value that stands at a share of the width. */
export function valueAt(histogram, share) {
  return histogram.low + Math.min(1, Math.max(0, share)) * (histogram.high - histogram.low);
}

/** Return the height of what stands in one bin, 1 for the fullest; by its logarithm, few beside many can be seen. */
export function heightOf(count, most, isLogarithmic) {
  if (count <= 0 || most <= 0) return 0;
  return isLogarithmic ? Math.log1p(count) / Math.log1p(most) : count / most;
}

/** Return the outline of a channel as an SVG path, in a square of 1 by 1. */
export function outline(counts, most, isLogarithmic) {
  const width = 1 / counts.length;
  const digits = (number) => Number(number.toFixed(4));
  let path = "M0 1";
  counts.forEach((count, bin) => {
    const top = digits(1 - heightOf(count, most, isLogarithmic));
    path += `V${top}H${digits((bin + 1) * width)}`;
  });
  return `${path}V1Z`;
}

/** Return the largest count of all channels. */
export function fullest(histogram) {
  return histogram.channels.reduce((most, channel) => channel.counts.reduce((a, b) => Math.max(a, b), most), 0);
}
