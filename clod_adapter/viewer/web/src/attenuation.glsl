float clodOpacity(float opacity, float sigma, float distance, float scale, float eps, float tau, bool soft) {
  float reach = max(sigma, 0.0);
  float x = distance * scale;
  float twice = 2.0 * reach * reach + eps;
  float u = x == 0.0 ? 0.0 : (twice > 0.0 ? x / twice * x : 1e30);
  float faded = opacity * exp(-u);
  float threshold = tau * scale;
  if (!(faded > threshold)) return 0.0;
  return soft ? faded * min(1.0, 2.0 * (faded / threshold - 1.0)) : faded;
}
