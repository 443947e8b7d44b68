// What is drawn of a Gaussian's opacity (CLoD-GS, Eq. 2, and its cut); 0 where it is left out.
// opacity: activated, in [0, 1]; sigma: the file's sigma_d; distance: |mean - camera| / D, at least 0; scale: the dial s,
// at least 0; eps, tau: of the file's header; soft: its cut, true where it fades to 0, false for the paper's hard one.
// For highp floats; golden.json beside this file has values to test it with.
float clodOpacity(float opacity, float sigma, float distance, float scale, float eps, float tau, bool soft) {
  float unit = max(max(sigma, 0.0), sqrt(eps));
  float far = distance * scale;
  float faded = opacity;
  if (far > 0.0) {
    if (far >= 100.0 * unit) return 0.0;  // exp(-3333) at most; and from here on nothing is divided by 0
    float x = far / unit;  // in this unit no square underflows or overflows
    float reach = max(sigma, 0.0) / unit;
    float root = sqrt(eps) / unit;
    faded *= exp(-x * x / (2.0 * reach * reach + root * root));
  }
  float threshold = tau * scale;
  if (!(faded > threshold)) return 0.0;
  return soft && faded < 1.5 * threshold ? faded * 2.0 * (faded / threshold - 1.0) : faded;
}

// The factor of the three scales of a Gaussian: those that the dial keeps grow with distance and dial; 1 for growth 0.
// growth: the file's growth_d; distance, scale: as above; reach: reference_distance / D of the header, 1 where that is 0,
// or for another normalizer.
float clodScale(float growth, float distance, float scale, float reach) {
  float magnification = clamp(distance * scale / reach, 1.0, 3e38);
  return exp(clamp(growth * log(magnification), -20.0, 20.0));
}
