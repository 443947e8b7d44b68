// What is drawn of a Gaussian's opacity: it fades to 0 at its reach, beyond which it is left out.
// opacity: activated, in [0, 1]; sigma: the file's sigma_d, the reach; distance: |mean - camera| / scene_distance, at
// least 0; scale: the dial s, at least 0; near: near_distance / scene_distance, at which far Gaussians take over from
// near ones, whose sigma is 0; 0 where there are none.
// For highp floats; golden.json beside this file has values to test it with.
float clodOpacity(float opacity, float sigma, float distance, float scale, float near) {
  float far = distance * scale, x = near > 0.0 ? min(far / near, 1.0) : 1.0, taken = max(12.0 * x * x - 11.0, 0.0);
  if (near > 0.0 && sigma <= 0.0) return opacity * (1.0 - taken);
  float t = far < sigma ? far / sigma : 1.0;
  return far > 0.0 ? opacity * taken * max(1.0 - t * t * t * t, 0.0) : opacity * taken;
}

// The factor of the three scales of a Gaussian: those that the dial keeps grow with distance and dial; 1 for growth 0.
// growth: the file's growth_d; distance, scale: as above; start: reference_distance / scene_distance, from where on
// Gaussians grow; 1 where reference_distance is 0.
float clodScale(float growth, float distance, float scale, float start) {
  float magnification = clamp(distance * scale / start, 1.0, 3e38);
  return exp(clamp(growth * log(magnification), -20.0, 20.0));
}
