#!/usr/bin/env python3
"""Licences and minimum Rust versions of the dependencies, from `cargo metadata`.

check           fails for a licence outside ALLOWED, and for a dependency that needs a newer Rust than ours
texts TARGET    prints the licences of what the program and the Python package for this target contain
"""

import collections
import json
import pathlib
import re
import subprocess
import sys

# Licences without copyleft: at most they ask for their text to be included.
ALLOWED = {
    "MIT", "MIT-0", "Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "ISC", "Zlib", "0BSD", "BSL-1.0", "CC0-1.0",
    "Unlicense",
    "Unicode-3.0",  # unicode-ident, for its tables
    "bzip2-1.0.6",  # libbz2-rs-sys; like BSD-3-Clause
}
# Exceptions only add permissions to those of the licence before WITH.
EXCEPTIONS = {"LLVM-exception"}

LICENCE_FILE = re.compile(r"\.?(licen[cs]e|copying|copyright|notice|unlicense)", re.IGNORECASE)


def metadata(*arguments):
    command = ["cargo", "metadata", "--locked", "--format-version", "1", *arguments]
    found = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    found["packages"] = {package["id"]: package for package in found["packages"]}
    return found


def host():
    version = subprocess.run(["rustc", "-vV"], check=True, stdout=subprocess.PIPE, text=True).stdout
    return re.search("^host: (.*)$", version, re.MULTILINE)[1]


def dependencies(found, kinds):
    """Packages that the workspace members depend on by these kinds (None is normal), directly or not."""
    nodes = {node["id"]: node["deps"] for node in found["resolve"]["nodes"]}
    members = set(found["workspace_members"])
    reached, waiting = set(members), list(members)
    while waiting:
        for dependency in nodes[waiting.pop()]:
            if dependency["pkg"] not in reached and any(kind["kind"] in kinds for kind in dependency["dep_kinds"]):
                reached.add(dependency["pkg"])
                waiting.append(dependency["pkg"])
    packages = [found["packages"][id] for id in reached - members]
    return sorted(packages, key=lambda package: (package["name"], version_key(package["version"])))


def version_key(version):
    """The three numbers of a version; 1.90 is 1.90.0."""
    numbers = [int(number) for number in re.match(r"[\d.]+", version)[0].split(".")]
    return (numbers + [0, 0])[:3]


def is_allowed(expression):
    """Whether an SPDX expression can be satisfied by ALLOWED; `/` is the old way to write OR."""
    tokens = re.findall(r"[()]|[^\s()]+", expression.replace("/", " OR "))

    def alternatives():
        allowed = conjunction()
        while tokens[:1] == ["OR"]:
            tokens.pop(0)
            allowed = conjunction() or allowed
        return allowed

    def conjunction():
        allowed = licence()
        while tokens[:1] == ["AND"]:
            tokens.pop(0)
            allowed = licence() and allowed
        return allowed

    def licence():
        token = tokens.pop(0)
        if token == "(":
            allowed = alternatives()
            if tokens.pop(0) != ")":
                raise ValueError
        else:
            allowed = token in ALLOWED
        if tokens[:1] == ["WITH"]:
            tokens.pop(0)
            allowed = tokens.pop(0) in EXCEPTIONS and allowed
        return allowed

    try:
        return alternatives() and not tokens
    except (IndexError, ValueError):
        return False


def check():
    assert is_allowed("(GPL-3.0 OR MIT) AND Unicode-3.0") and is_allowed("Apache-2.0 WITH LLVM-exception/GPL-2.0")
    assert not any(map(is_allowed, ["GPL-3.0", "MIT AND GPL-3.0", "MIT OR GPL-3.0 AND", "(MIT", ""]))

    try:
        found = metadata()
    except subprocess.CalledProcessError:
        print("packages for other systems could not be downloaded; those of this one are checked")
        found = metadata("--filter-platform", host())
    errors = []
    shipped = dependencies(found, {None, "build"})
    for package in shipped:
        expression = package["license"] or ""
        if not is_allowed(expression):
            errors.append(
                f"{package['name']} {package['version']}: the licence {expression!r} is not allowed; "
                "replace the package, or add the licence to ALLOWED in .ci/dependencies.py with a reason"
            )

    ours = [found["packages"][id] for id in found["workspace_members"]]
    promised = {package["rust_version"] for package in ours}
    if len(promised) != 1:
        errors.append(f"rust-version differs between the packages of the workspace: {promised}")
    oldest = min(promised, key=version_key)
    for package in dependencies(found, {None, "build", "dev"}):
        needed = package["rust_version"]
        if needed and version_key(needed) > version_key(oldest):
            errors.append(
                f"{package['name']} {package['version']} needs Rust {needed}, rust-version is {oldest}; "
                f"take an older version (cargo update -p {package['name']} --precise VERSION), or raise rust-version"
            )

    versions = collections.defaultdict(list)
    for package in shipped:
        versions[package["name"]].append(package["version"])
    print(f"{len(shipped)} packages, Rust {oldest}; in several versions: ", end="")
    print(", ".join(f"{name} {' '.join(all)}" for name, all in versions.items() if len(all) > 1) or "none")
    sys.exit("\n".join(errors) or None)


def texts(target):
    found = metadata("--filter-platform", target)
    packages = dependencies(found, {None})
    print("fpmcl contains these packages, whose licences follow.\n")
    for package in packages:
        print(f"{package['name']} {package['version']}: {package['license']}, {package['repository'] or 'crates.io'}")

    # Most texts are the same in many packages, up to white space.
    users = collections.defaultdict(list)
    first = {}
    without = []
    for package in packages:
        folder = pathlib.Path(package["manifest_path"]).parent
        files = [file for file in sorted(folder.rglob("*")) if LICENCE_FILE.match(file.name) and file.is_file()]
        files = [file for file in files if file.suffix not in (".rs", ".toml")]
        if not files:
            without.append(package)
        for file in files:
            text = file.read_text(encoding="utf-8", errors="replace").replace("\r\n", "\n").strip()
            text = first.setdefault(" ".join(text.split()), text)
            users[text].append(f"{package['name']} {package['version']}")

    mit = pathlib.Path("LICENSE").read_text(encoding="utf-8").partition("Permission is hereby")
    for package in without:
        name = f"{package['name']} {package['version']}"
        if "MIT" in package["license"]:
            holders = ", ".join(package["authors"]) or f"the authors of {package['name']}"
            users[f"Copyright (c) {holders}\n\n{mit[1]}{mit[2]}".strip()].append(name)
        elif "Apache-2.0" in package["license"]:
            standard = max((text for text in users if text.startswith("Apache License")), key=lambda text: len(users[text]))
            users[standard].append(name)
        else:
            sys.exit(f"{name}: no text of {package['license']} in the package; add it to .ci/dependencies.py")
    for text, names in users.items():
        print(f"\n{'-' * 100}\n{', '.join(dict.fromkeys(names))}\n\n{text}")


if __name__ == "__main__":
    if sys.argv[1:] == ["check"]:
        check()
    elif len(sys.argv) == 3 and sys.argv[1] == "texts":
        texts(sys.argv[2])
    else:
        sys.exit(__doc__)
