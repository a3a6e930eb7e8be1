"""From inertial and Doppler samples to motion and its covariance; no landmarks here."""
