// Which Gaussians are outside the picture: neither sorted nor drawn.

const MARGIN = 0.25; // of the picture on each side: Gaussians that a moving camera shows before the next order
const RADIUS = 3.34; // standard deviations to alpha 1/255, and more than in shaders.js

/** The bounds of a view: across and down, a Gaussian at camera coordinates [x, y, z] has a pixel in the picture or its margin
 *  only if |focal x + shift z| <= border z + reach scale, where no axis of it is longer than `scale`. `blur`: variance of the
 *  screen-space filter. The extent is that of shaders.js, with the largest slope of the clamped ray. */
export function frustumOf({ fx, fy, cx, cy, width, height }, blur) {
  const along = (focal, centre, size) => {
    const slope = (Math.max(centre, size - centre) + 0.15 * size) / focal;
    return [focal, centre - size / 2, (0.5 + MARGIN) * size + RADIUS * Math.sqrt(blur), RADIUS * focal * Math.hypot(1, slope)];
  };
  const [focal, shift, border, reach] = along(fx, cx, width).map((value, k) => [value, along(fy, cy, height)[k]]);
  return { focal, shift, border, reach };
}
