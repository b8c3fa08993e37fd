"""Other solvers on the fragment solver's own energies: PyTorch's L-BFGS, SciPy, Ceres.

A scene holds a recording's fragments in one space, and scores every solver's answer with the package's
own energy and gradient. L-BFGS minimises the energy as such: the Cartesian one written once more in
PyTorch and differentiated by autograd, the joint-space one through the package's value and gradient in an
`autograd.Function`. SciPy's least squares and Ceres get the residuals, whose squares sum to twice the
energy, as small CasADi functions of one, three or four frames in a row (`Residuals`), compiled like the
package's own, with their derivatives by CasADi. Robust losses are in them: a residual times
sqrt(loss / square).

Variables z (N, F) are joint positions (F = 3J), or in joint space the step from the start in tangent
coordinates (F = D). The peers know no limits.
"""
