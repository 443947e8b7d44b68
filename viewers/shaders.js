// Made by clod_adapter/viewer/web/build.mjs from clod_adapter/integrations/shaders/.
export const glsl = `// What is drawn of a Gaussian's opacity (CLoD-GS, Eq. 2, and its cut); 0 where it is left out.
//   opacity   activated, in [0, 1]
//   sigma     the file's sigma_d
//   distance  |mean - camera| / D, at least 0
//   scale     the dial s, at least 0
//   eps, tau  of the file's header
//   soft      the header's cut: true where it fades to 0, false for the paper's hard one
// For highp floats; golden.json beside this file has values to test it with.
float clodOpacity(float opacity, float sigma, float distance, float scale, float eps, float tau, bool soft) {
  float reach = max(sigma, 0.0);
  float root = sqrt(eps);
  float unit = max(reach, root);
  float x = distance * scale;
  float faded = opacity;
  if (x > 0.0) {
    if (x >= 100.0 * unit) return 0.0;  // exp(-3333) at most; and from here on nothing is divided by 0
    x /= unit;  // in this unit no square underflows or overflows
    reach /= unit;
    root /= unit;
    faded *= exp(-x * x / (2.0 * reach * reach + root * root));
  }
  float threshold = tau * scale;
  if (!(faded > threshold)) return 0.0;
  return soft && faded < 1.5 * threshold ? faded * 2.0 * (faded / threshold - 1.0) : faded;
}

// The factor of the three scales of a Gaussian: those that the dial keeps grow with distance and dial; 1 for growth 0.
//   growth    the file's growth_d
//   distance  as above
//   scale     the dial s, as above
//   reach     reference_distance / D of the header; 1 where reference_distance is 0, or for another normalizer
float clodScale(float growth, float distance, float scale, float reach) {
  float magnification = clamp(distance * scale / reach, 1.0, 3e38);
  return exp(clamp(growth * log(magnification), -20.0, 20.0));
}
`;
export const wgsl = `// What is drawn of a Gaussian's opacity (CLoD-GS, Eq. 2, and its cut); 0 where it is left out.
//   opacity   activated, in [0, 1]
//   sigma     the file's sigma_d
//   distance  |mean - camera| / D, at least 0
//   scale     the dial s, at least 0
//   eps, tau  of the file's header
//   soft      the header's cut: true where it fades to 0, false for the paper's hard one
// golden.json beside this file has values to test it with.
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
//   growth    the file's growth_d
//   distance  as above
//   scale     the dial s, as above
//   reach     reference_distance / D of the header; 1 where reference_distance is 0, or for another normalizer
fn clodScale(growth: f32, distance: f32, scale: f32, reach: f32) -> f32 {
  let magnification = clamp(distance * scale / reach, 1.0, 3e38);
  return exp(clamp(growth * log(magnification), -20.0, 20.0));
}
`;
