# Shared set-up of scripts/demo, scripts/test and .ci/run; source this file.

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv=$root/.venv
cd "$root"

say() { printf '\n==> %s\n' "$*"; }

# set_up EXTRA...: system packages, virtual environment, and the package with these extras.
set_up() {
  install_system_packages
  make_virtual_environment
  install_package "$@"
}

# Print the first Python that is new enough, or nothing.
find_python() {
  local name
  for name in python3 python3.14 python3.13 python3.12 python3.11 python3.10; do
    if command -v "$name" >/dev/null &&
      "$name" -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null; then
      echo "$name"
      return
    fi
  done
}

has_library() { { ldconfig -p || /sbin/ldconfig -p; } 2>/dev/null | grep -q "$1"; }

# Print the Debian packages that pip cannot install and this machine lacks, each with its purpose.
missing_system_packages() {
  local python
  python=$(find_python)
  command -v c++ >/dev/null || echo "g++                  # compiles the core"
  [[ -n $python ]] || echo "python3              # 3.10 or newer"
  [[ -n $python ]] && "$python" -c 'import ensurepip, venv' 2>/dev/null ||
    echo "python3-venv         # makes the virtual environment"
  [[ -n $python ]] && "$python" -c '
import pathlib, sys, sysconfig
sys.exit(not pathlib.Path(sysconfig.get_path("include"), "Python.h").exists())' ||
    echo "python3-dev          # compiles the core"
  # Determined by hiding one library after the other: without a display, VTK draws through EGL on
  # Mesa's software renderer, and VTK crashes without libX11.
  has_library libEGL.so.1 || echo "libegl1              # pictures without a display"
  compgen -G '/usr/lib/*/dri/swrast_dri.so' >/dev/null ||
    echo "libgl1-mesa-dri      # pictures without a display"
  has_library libX11.so.6 || echo "libx11-6             # pictures"
  has_library libXcursor.so.1 || echo "libxcursor1          # pictures"
}

install_system_packages() { install_packages "$(missing_system_packages)"; }

# install_packages LINES: install the packages of lines "package  # purpose", if no password is
# needed: as root, or with sudo without password.
install_packages() {
  local missing=$1 names sudo=()
  [[ -n $missing ]] || return 0
  mapfile -t names < <(sed 's/ *#.*//' <<<"$missing")
  if ((EUID != 0)); then sudo=(sudo -n); fi
  if ! command -v apt-get >/dev/null || ! "${sudo[@]}" true 2>/dev/null; then
    say "Skipped: system packages, for want of apt-get or the right to use it. Missing are"
    echo "$missing"
    return 0
  fi
  say "Installing system packages: ${names[*]}"
  "${sudo[@]}" apt-get update -qq
  "${sudo[@]}" env DEBIAN_FRONTEND=noninteractive \
    apt-get install -qq -y --no-install-recommends "${names[@]}" >/dev/null
}

make_virtual_environment() {
  local python
  if [[ -x $venv/bin/pip ]]; then return 0; fi
  python=$(find_python)
  if [[ -z $python ]]; then
    echo "Python 3.10 or newer is needed (Debian: python3 python3-venv python3-dev)." >&2
    return 1
  fi
  say "Making the virtual environment .venv with $("$python" --version)"
  "$python" -m venv "$venv"
}

pip_install() { "$venv/bin/pip" install --quiet --disable-pip-version-check -c constraints.txt "$@"; }

# Fingerprint of the files that require a new installation if they change. Python files are not
# among them, because the installation is editable.
fingerprint() {
  {
    find csrc setup.py pyproject.toml constraints.txt -type f -print0 | LC_ALL=C sort -z |
      xargs -0 sha256sum
    "$venv/bin/python" -VV
    echo "${CMAKE_ARGS:-} ${CXX:-} ${CXXFLAGS:-}"
  } | sha256sum
}

# requirements EXTRA...: print the package's requirements in pyproject.toml, with these extras.
requirements() {
  "$venv/bin/python" - "$@" <<'PY'
import sys
from setuptools.config.pyprojecttoml import load_file
project = load_file("pyproject.toml")["project"]
extras = project["optional-dependencies"]
print(*project["dependencies"], *(name for e in sys.argv[1:] for name in extras[e]), sep="\n")
PY
}

# install_requirements EXTRA...: install the package's requirements, with these extras, but not the
# package; nothing is compiled.
install_requirements() {
  local now required=()
  now=$(cat pyproject.toml constraints.txt <("$venv/bin/python" -VV) <(echo "$*") | sha256sum)
  if [[ $(cat "$venv/required" 2>/dev/null) == "$now" ]]; then return 0; fi
  say "Installing what the package needs, with the extras $*: nothing is compiled"
  pip_install setuptools
  mapfile -t required < <(requirements "$@")
  pip_install "${required[@]}"
  echo "$now" >"$venv/required"
}

# install_package EXTRA...: install the package as editable, unless it is installed and unchanged;
# then install only missing extras, without a build.
install_package() {
  local extra now missing=() required=() stale='' switches=${CMAKE_ARGS:-}
  now=$(fingerprint)
  [[ $(cat "$venv/installed" 2>/dev/null) == "$now" ]] || stale=yes
  compgen -G 'diffcloth_torch/_core*.so' >/dev/null || stale=yes
  # Tests call single kernels. Once built, the kernels are rebuilt with the rest.
  if [[ " $* " == *" test "* ]]; then
    compgen -G 'diffcloth_torch/_kernels*.so' >/dev/null || stale=yes
    switches+=" -DDIFFCLOTH_KERNELS=ON"
  elif compgen -G 'diffcloth_torch/_kernels*.so' >/dev/null; then
    switches+=" -DDIFFCLOTH_KERNELS=ON"
  fi

  if [[ -n $stale ]]; then
    say "Building the package and installing what it needs: a few minutes the first time"
    # The build's own requirements go into .venv, so that a second build compiles only what changed.
    pip_install setuptools cmake ninja nanobind cmeel-eigen
    # The compiler needs the cores, pip the network and one core: run both at once.
    mkdir -p build
    CMAKE_ARGS=$switches PATH=$venv/bin:$PATH \
      "$venv/bin/python" setup.py --quiet build_ext >build/core.txt 2>&1 &
    local compiling=$! compiled=0
    trap 'kill "$compiling" 2>/dev/null || true' EXIT
    mapfile -t required < <(requirements "$@")
    pip_install "${required[@]}"
    wait "$compiling" || compiled=$?
    trap - EXIT
    if ((compiled)); then
      cat build/core.txt >&2
      return "$compiled"
    fi
    CMAKE_ARGS=$switches PATH=$venv/bin:$PATH pip_install --no-build-isolation --editable .
    echo "$now" >"$venv/installed"
  fi
  for extra in "$@"; do
    [[ $(cat "$venv/installed-$extra" 2>/dev/null) == "$now" ]] || missing+=("$extra")
  done
  if ((${#missing[@]})); then
    say "Installing the extras ${missing[*]}"
    # Use the name, not the folder, so that pip recognizes the installed package.
    pip_install "diffcloth-torch[$(
      IFS=,
      echo "${missing[*]}"
    )]"
    for extra in "${missing[@]}"; do echo "$now" >"$venv/installed-$extra"; done
  fi
}
