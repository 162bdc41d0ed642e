"""How effects get into the plant: what MuJoCo has natively, set per simulation, and forces planned before it.

Each mechanism adds its elements to the description of the plant and writes its values into the fields of a batch:
springs with a dead band, polynomials, elasto-plastic springs, dry friction, LuGre, a hidden joint, turned axes, other
masses and impedances. No Python runs while it steps, but where a controller answers the strap: between short windows.
"""
