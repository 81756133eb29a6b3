#!/bin/sh
# Starts the image's service. The kernels that were compiled with the image are copied to where numba may write: those
# that do not fit this machine's processor are then compiled anew, and kept.
set -eu
if grep -qs test-site /run/secrets/page_users; then # anybody can read the password in the project's repository
    case ${PUBLISHED_ON:-} in
        127.* | localhost | ::1 | '[::1]') echo "warning: the page's user is the one that comes with the project" >&2 ;;
        *)
            echo "error: the page's user is the one that comes with the project, and ports are published on" \
                "${PUBLISHED_ON:-}: write page.users with users of your own (python -m coldloop_hmi.users), and name its folder in" \
                "COLDLOOP_PASSWORDS" >&2
            exit 1
            ;;
    esac
fi
[ -e "$COLDLOOP_CACHE_DIR" ] || cp -R /opt/coldloop/kernels "$COLDLOOP_CACHE_DIR"
exec python -m "coldloop_$SERVICE" "$@"
