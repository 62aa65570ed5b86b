"""The point estimate: problem, prior, noise, minimisation, signs and goodness of fit."""
