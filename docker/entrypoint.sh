#!/bin/sh
# Starts the image's service. The kernels that were compiled with the image are copied to where numba may write: those
# that do not fit this machine's processor are then compiled anew, and kept.
set -eu
[ -e "$COLDLOOP_CACHE_DIR" ] || cp -R /opt/coldloop/kernels "$COLDLOOP_CACHE_DIR"
exec python -m "$SERVICE" "$@"
