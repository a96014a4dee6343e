// What codes and numbers of the answer mean, in words.

export const nameOfStream = (id) => (id === "~uploads" ? "Inspected pairs" : id);
export const LABELS = { independent_motion: "Independent motion", model_error: "Model error" };

const RULES = {
  extended_in_x_and_y: "wide in both directions, as a thing that moves is",
  shape_not_judged: "its shape was not judged",
  narrow_in_x: "a narrow band: too narrow from left to right",
  narrow_in_y: "a narrow band: too narrow from top to bottom",
  narrow_in_x_and_y: "too small in both directions",
  narrow_across: "a narrow band: too thin across",
  band_by_aspect_ratio: "a band: many times longer than wide",
  most_of_the_picture: "more than half of the picture seems to move, so the explanation is wrong, not the world",
};

/** Why a region carries its label, in one or two sentences. */
export function verdict(roi, motionScore) {
  const rule = RULES[roi.evidence.rule] ?? String(roi.evidence.rule ?? "no rule was told");
  const score = roi.score.toFixed(2);
  if (roi.label === "independent_motion") {
    return `Motion: it is ${rule}, and its score ${score} reaches the threshold ${motionScore.toFixed(2)}.`;
  }
  if (roi.evidence.two_frame_score !== undefined) {
    return `Model error: two frames alone would have called it motion (${Number(roi.evidence.two_frame_score).toFixed(2)}), but no track confirms it yet.`;
  }
  if (roi.evidence.rule === "extended_in_x_and_y" || roi.evidence.rule === "shape_not_judged") {
    return `Model error: it is ${rule}, but its score ${score} stays below the threshold ${motionScore.toFixed(2)}.`;
  }
  return `Model error: it is ${rule}.`;
}

/** name -> [what it is, unit, what it tells] */
export const EVIDENCE = {
  probability: ["Probability of its pixels", "", "mean over the region, from the evidence head"],
  min_probability: ["Needed by a pixel", "", "to take part in the region"],
  across_epipolar_px: ["Motion no depth explains", "px", "remaining flow across the epipolar line"],
  along_epipolar_px: ["Motion a wrong depth could explain", "px", "remaining flow along the epipolar line"],
  parallax_px: ["Parallax", "px", "how far it would shift were it e times as near"],
  contrast: ["Contrast to the threshold", "", "1 is at the threshold"],
  threshold_gray: ["Threshold", "gray", "of the residual"],
  fill_ratio: ["Share of its box", "", "that the region covers"],
  aspect_ratio: ["Long over short side", "", "of its box"],
  static_flow_u_px: ["Static world goes right", "px", "in its middle, until the next frame"],
  static_flow_v_px: ["Static world goes down", "px", "in its middle, until the next frame"],
  own_velocity_u_px_s: ["Own velocity, right", "px/s", "beyond the static world"],
  own_velocity_v_px_s: ["Own velocity, down", "px/s", "beyond the static world"],
  two_frame_score: ["Score of two frames alone", "", "before tracking"],
};

export const number = (value, digits = 2) =>
  value === null || value === undefined ? "unknown" : Number(value).toFixed(digits);

export function ago(ns) {
  const seconds = Math.max(0, Date.now() / 1000 - ns / 1e9);
  if (seconds < 2) return "now";
  if (seconds < 90) return `${Math.round(seconds)} s ago`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min ago`;
  return `${Math.round(seconds / 3600)} h ago`;
}

/** Whether a pair is too old to say what moves now. */
export const isQuiet = (ns) => Date.now() / 1000 - ns / 1e9 > 30;

export const moving = (detection) => detection.rois.filter((roi) => roi.label === "independent_motion");

export function counted(count, one, many = `${one}s`) {
  return `${count} ${count === 1 ? one : many}`;
}
