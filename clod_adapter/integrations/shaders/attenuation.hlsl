// What is drawn of a Gaussian's opacity: it fades to 0 at its reach, beyond which it is left out.
// Arguments as in attenuation.glsl. For float, which is 32 bits wide: half and min16float are too narrow.
float clodOpacity(float opacity, float sigma, float seenFrom, float scale, float nearDistance) {
  float reached = seenFrom * scale;
  float x = nearDistance > 0.0 ? min(reached / nearDistance, 1.0) : 1.0;
  float taken = max(12.0 * x * x - 11.0, 0.0);
  if (nearDistance > 0.0 && sigma <= 0.0) return opacity * (1.0 - taken);
  float t = reached < sigma ? reached / sigma : 1.0;
  return reached > 0.0 ? opacity * taken * max(1.0 - t * t * t * t, 0.0) : opacity * taken;
}

// The factor of the three scales of a Gaussian: those that the dial keeps grow with distance and dial; 1 for growth 0.
float clodScale(float growth, float seenFrom, float scale, float start) {
  float magnification = clamp(seenFrom * scale / start, 1.0, 3e38);
  return exp(clamp(growth * log(magnification), -20.0, 20.0));
}
