"""Writes scikit_fuzzy.txt: random fuzzy systems and what scikit-fuzzy 0.5.0 infers from them.

    python src/ground/scikit_fuzzy.py > src/ground/scikit_fuzzy.txt

One system a line: operators; sets of inputs a and b and of the output as shape and corners;
rules as (a set, b set, output set, OR?); then inputs and centroid.
"""

import numpy as np
import skfuzzy as fuzz

rng = np.random.default_rng(4)
universe = np.linspace(0, 1, 2001)


def shape():
    kind = rng.choice(["trapezoid", "triangle", "gaussian"])
    if kind == "gaussian":
        return kind, [round(rng.uniform(0, 1), 3), round(rng.uniform(0.05, 0.4), 3)]
    corners = 4 if kind == "trapezoid" else 3
    return kind, sorted(round(x, 3) for x in rng.uniform(-0.2, 1.2, corners))


def curve(shape, x):
    kind, corners = shape
    x = np.atleast_1d(np.asarray(x, float))
    if kind == "gaussian":
        return fuzz.gaussmf(x, *corners)
    return fuzz.trapmf(x, corners) if kind == "trapezoid" else fuzz.trimf(x, corners)


for number in range(60):
    product = number % 2 == 1
    a, b, out = ([shape() for _ in range(3)] for _ in range(3))
    rules = [(*(int(i) for i in rng.integers(0, 3, 3)), bool(rng.integers(0, 2))) for _ in range(4)]
    x, y = (round(v, 3) for v in rng.uniform(0, 1, 2))
    union = np.zeros_like(universe)
    for i, j, k, either in rules:
        p, q = curve(a[i], x)[0], curve(b[j], y)[0]
        if either:
            strength = p + q - p * q if product else np.fmax(p, q)
        else:
            strength = p * q if product else np.fmin(p, q)
        implied = curve(out[k], universe)
        implied = implied * strength if product else np.fmin(implied, strength)
        union = np.fmax(union, implied)
    if union.sum() < 1:  # hardly any rule fires
        continue
    words = ["product" if product else "min_max"]
    words += [f"{kind}:{','.join(map(str, corners))}" for kind, corners in a + b + out]
    words += [f"{i},{j},{k},{'OR' if either else 'AND'}" for i, j, k, either in rules]
    print(*words, x, y, f"{fuzz.defuzz(universe, union, 'centroid'):.6f}")
