// What is drawn of a Gaussian's opacity: it fades to 0 at its reach, beyond which it is left out.
// Arguments as in attenuation.glsl.
fn clodOpacity(opacity: f32, sigma: f32, distance: f32, scale: f32, near: f32) -> f32 {
  let far = distance * scale;
  let x = select(1.0, min(far / near, 1.0), near > 0.0);
  let taken = max(12.0 * x * x - 11.0, 0.0);
  if (near > 0.0 && sigma <= 0.0) { return opacity * (1.0 - taken); }
  let t = select(1.0, far / sigma, far < sigma);
  return opacity * taken * select(1.0, max(1.0 - t * t * t * t, 0.0), far > 0.0);
}

// The factor of the three scales of a Gaussian: those that the dial keeps grow with distance and dial; 1 for growth 0.
fn clodScale(growth: f32, distance: f32, scale: f32, start: f32) -> f32 {
  let magnification = clamp(distance * scale / start, 1.0, 3e38);
  return exp(clamp(growth * log(magnification), -20.0, 20.0));
}
