"""Output fields of one's own, in a line each."""

# recipe: begin
import ufl

import polarmpm as pm

MISES = pm.MaterialField("mises", lambda s: ufl.sqrt(1.5 * ufl.inner(ufl.dev(s.stress), s.stress)), "Pa")
DEPTH = pm.Field("depth", lambda p: -p.x[:, 1], "m")
# recipe: end
