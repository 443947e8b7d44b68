// What is drawn of a Gaussian's opacity (CLoD-GS, Eq. 2, and its cut); 0 where it is left out.
// Arguments as in attenuation.glsl.
fn clodOpacity(opacity: f32, sigma: f32, distance: f32, scale: f32, eps: f32, tau: f32, soft: bool) -> f32 {
  let unit = max(max(sigma, 0.0), sqrt(eps));
  let far = distance * scale;
  var faded = opacity;
  if (far > 0.0) {
    if (far >= 100.0 * unit) { return 0.0; }  // exp(-3333) at most; and from here on nothing is divided by 0
    let x = far / unit;  // in this unit no square underflows or overflows
    let reach = max(sigma, 0.0) / unit;
    let root = sqrt(eps) / unit;
    faded *= exp(-x * x / (2.0 * reach * reach + root * root));
  }
  let threshold = tau * scale;
  if (!(faded > threshold)) { return 0.0; }
  if (soft && faded < 1.5 * threshold) { return faded * 2.0 * (faded / threshold - 1.0); }
  return faded;
}

// The factor of the three scales of a Gaussian: those that the dial keeps grow with distance and dial; 1 for growth 0.
fn clodScale(growth: f32, distance: f32, scale: f32, reach: f32) -> f32 {
  let magnification = clamp(distance * scale / reach, 1.0, 3e38);
  return exp(clamp(growth * log(magnification), -20.0, 20.0));
}
