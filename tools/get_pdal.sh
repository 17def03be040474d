#!/bin/sh
# Get PDAL for this checkout alone, into .pdal, on Debian 12, which has no package of it.
#
#   tools/get_pdal.sh          where it is not there yet; cannot fail a set-up
#   tools/get_pdal.sh --again  try anew, and fail where it is not to be had
#
# Debian 11 has PDAL 2.2. Its packages come from the mirror that this machine's apt uses already,
# and apt checks their signatures; but apt and dpkg do all this in a folder of their own, so the
# system stays as it is and root is not needed. The programs run under the loader and the libraries
# that came with them, and the folder can be moved.
set -eu
cd "$(dirname "$0")/.."

suite=bullseye
place=.pdal
reason=$place/not-there # a file in place of a PDAL: why there is none
retry_after_min=60
# What apt wants for an installed system and the program does without.
unneeded="coreutils debconf dpkg fontconfig-config fonts-dejavu-core gcc-10-base libtirpc-common
    mariadb-common mysql-common odbcinst perl-base sensible-utils tar ucf"

again=
[ "${1:-}" != --again ] || again=yes

give_up() {
    echo "set-up: no PDAL: $*; the road mask uses the built-in engine." >&2
    [ -z "$again" ] || exit 1
    exit 0
}

# A reason that may pass is kept for an hour, so that not every target waits for a network.
give_up_for_now() {
    if [ ! -x $place/bin/pdal ]; then
        mkdir -p $place
        echo "$*" >$reason
    fi
    give_up "$*"
}

# Any other holds until this file changes.
give_up_for_good() {
    mkdir -p $place
    cksum <tools/get_pdal.sh >$place/for-good
    give_up_for_now "$*"
}

is_debian_12() {
    # shellcheck source=/dev/null
    [ -r /etc/os-release ] && (. /etc/os-release && [ "${ID:-}:${VERSION_ID:-}" = debian:12 ])
}

starts() {
    "$1" --version >/dev/null 2>&1
}

# apt's own settings (proxies, certificates, passwords of mirrors), then ours over them.
# Insecure repositories stay off whatever the machine says. Dates are checked as the machine
# has it: this suite's Release file has no end date, so nothing expires by that.
write_settings() {
    main=
    eval "$(apt-config shell main Dir::Etc::main/f)"
    {
        [ ! -f "$main" ] || echo "#include \"$main\";"
        cat <<END
#clear APT::Update::Pre-Invoke;
#clear APT::Update::Post-Invoke;
#clear APT::Update::Post-Invoke-Success;
#clear APT::Architectures;
#clear APT::Default-Release;
APT::Architecture "$architecture";
APT::Get::AllowUnauthenticated "false";
APT::Get::Show-User-Simulation-Note "false";
APT::Install-Recommends "false";
APT::Install-Suggests "false";
Acquire::AllowInsecureRepositories "false";
Acquire::AllowWeakRepositories "false";
Acquire::AllowDowngradeToInsecureRepositories "false";
Acquire::Languages "none";
Acquire::Retries "2";
Acquire::http::Timeout "15";
Acquire::https::Timeout "15";
Dir::State "$build/apt";
Dir::State::lists "$build/apt/lists";
Dir::State::status "$build/apt/status";
Dir::Cache "$build/apt";
Dir::Cache::archives "$build/apt/archives";
Dir::Etc::sourcelist "$build/apt/sources.list";
Dir::Etc::sourceparts "$build/apt/sources.list.d";
Dir::Etc::preferences "/dev/null";
Dir::Etc::preferencesparts "/dev/null";
END
    } >"$build/apt/apt.conf"
    {
        [ -z "${APT_CONFIG:-}" ] || echo "#include \"$APT_CONFIG\";"
        echo "Dir::Etc::main \"$build/apt/apt.conf\";"
    } >"$build/apt/first.conf"
}

# The entries of this machine's apt for its own release, with the other suite in its place.
# Mirror and keys stay; an entry that trusts its mirror without keys no longer does.
write_sources() {
    list=
    parts=
    eval "$(apt-config shell list Dir::Etc::sourcelist/f parts Dir::Etc::sourceparts/d)"
    for file in "$list" "$parts"*.list; do
        [ ! -r "$file" ] || cat "$file"
        echo
    done | awk -v suite=$suite '
        $1 != "deb" { next }
        {
            options = ""
            rest = $0
            sub(/#.*/, "", rest)
            sub(/^[ \t]*deb[ \t]+/, "", rest)
            if (rest ~ /^\[/) {
                options = substr(rest, 1, index(rest, "]"))
                rest = substr(rest, index(rest, "]") + 1)
                gsub(/(trusted|allow-insecure|allow-weak)=[^] ]*/, "", options)
                gsub(/(arch|lang|target|snapshot)[+-]?=[^] ]*/, "", options)
            }
            n = split(rest, word, " ")
            if (word[1] ~ /^cdrom:/ || word[2] != "bookworm") next
            for (i = 3; i <= n; i++)
                if (word[i] == "main") print "deb", options, word[1], suite, "main"
        }' | sort -u >"$build/apt/sources.list"
    mkdir "$build/apt/sources.list.d"
    for file in "$parts"*.sources; do
        [ -r "$file" ] || continue
        copy=$build/apt/sources.list.d/$(basename "$file")
        awk -v suite=$suite '
            function finish() {
                if (deb && release && main && !off)
                    printf "%sSuites: %s\nComponents: main\n\n", kept, suite
                kept = ""
                deb = release = main = off = skip = 0
            }
            /^#/ { next }
            /^[ \t]*$/ { finish(); next }
            /^[ \t]/ {
                if (field == "suites:") words($0, "bookworm")
                if (field == "components:") words($0, "main")
                if (!skip) kept = kept $0 "\n"
                next
            }
            function words(text, wanted) {
                if (index(" " text " ", " " wanted " ") == 0) return
                if (wanted == "bookworm") release = 1
                if (wanted == "main") main = 1
                if (wanted == "deb") deb = 1
            }
            {
                field = tolower($1)
                text = $0
                sub(/^[^:]*:/, "", text)
                gsub(/\t/, " ", text)
                if (field == "types:") words(text, "deb")
                if (field == "suites:") words(text, "bookworm")
                if (field == "components:") words(text, "main")
                if (field == "enabled:" && tolower(text) ~ /no|false|off|0/) off = 1
                skip = field !~ /^(uris|signed-by):$/
                if (!skip) kept = kept $0 "\n"
                if (field == "types:") kept = kept "Types: deb\n"
            }
            END { finish() }' "$file" >"$copy"
        [ -s "$copy" ] || rm "$copy"
    done
    [ -s "$build/apt/sources.list" ] || [ -n "$(ls "$build/apt/sources.list.d")" ]
}

private_apt() {
    LC_ALL=C APT_CONFIG=$build/apt/first.conf DEBIAN_FRONTEND=noninteractive \
        timeout --foreground 600 "$@" >>"$build/log" 2>&1 </dev/null
}

# What apt said, on one line.
last_error() {
    sed -n 's/^[EW]: *//p' "$build/log" | head -n 1 | cut -c 1-200
}

download() {
    mkdir -p "$build/apt/lists/partial" "$build/apt/archives/partial"
    : >"$build/apt/status"
    write_settings
    write_sources || give_up "apt knows no source of Debian 12's packages here"
    private_apt apt-get update -eany -o Acquire::Retries=0 ||
        give_up_for_now "Debian 11's packages cannot be reached ($(last_error))"
    # What counts as installed is not fetched, nor is what only that needs.
    # shellcheck disable=SC2086 # one word a package
    LC_ALL=C APT_CONFIG=$build/apt/first.conf apt-cache show --no-all-versions $unneeded \
        2>>"$build/log" |
        awk '/^Package: / { print; print "Status: install ok installed" }
            /^(Version|Architecture|Multi-Arch): |^$/' >"$build/apt/installed"
    mv "$build/apt/installed" "$build/apt/status"
    echo "set-up: fetching PDAL into $place (60 MB, once; about 10 s)."
    private_apt apt-get install --yes --download-only pdal ||
        give_up_for_now "Debian 11's packages cannot be fetched ($(last_error))"
}

unpack() {
    mkdir "$build/pdal"
    for package in "$build"/apt/archives/*.deb; do
        dpkg -x "$package" "$build/pdal" >>"$build/log" 2>&1 ||
            give_up_for_now "a package cannot be unpacked ($(tail -n 1 "$build/log"))"
    done
    (
        cd "$build/pdal"
        mv usr/share share
        rm -rf etc lib64 var usr/sbin usr/lib/*/gconv usr/lib/*/audit
        mkdir usr/share
        mv share/proj share/gdal usr/share/
        rm -rf share
        chmod -R u+w,go+rX .
    )
}

# Other machines' names of loader and folders differ, so they are looked up once, here.
write_program() {
    mkdir "$build/pdal/bin"
    loader=$(cd "$build/pdal" && find lib -name 'ld-[0-9]*.so' | head -n 1)
    [ -n "$loader" ] || give_up_for_good "its loader is not known for $architecture"
    triplet=$(basename "$(dirname "$loader")")
    cat >"$build/pdal/bin/pdal" <<END
#!/bin/sh
# PDAL under the loader, libraries and data that lie beside it, and nothing of the system's.
here=\$(dirname "\$(dirname "\$(readlink -f "\$0")")")
libraries=\$here/usr/lib
for folder in usr/lib/$triplet lib/$triplet usr/lib/$triplet/blas usr/lib/$triplet/lapack; do
    libraries=\$libraries:\$here/\$folder
done
unset LD_LIBRARY_PATH LD_PRELOAD PROJ_DATA GDAL_DRIVER_PATH
export PROJ_LIB="\$here/usr/share/proj" GDAL_DATA="\$here/usr/share/gdal"
export PDAL_DRIVER_PATH="\$here/usr/lib" GCONV_PATH="\$here/usr/lib" LC_ALL=C
exec "\$here/$loader" --library-path "\$libraries" "\$here/usr/bin/pdal" "\$@"
END
    chmod 755 "$build/pdal/bin/pdal"
    starts "$build/pdal/bin/pdal" ||
        give_up_for_good "Debian 11's PDAL does not start here"
}

put_in_place() {
    rm -rf "$build/before"
    [ ! -e $place ] || mv -T $place "$build/before"
    mv -T "$build/pdal" $place
}

if [ -z "$again" ]; then
    [ ! -x $place/bin/pdal ] || ! starts $place/bin/pdal || exit 0
    [ -z "${GIS_RADAR_PDAL:-}" ] || exit 0
    ! starts pdal || exit 0 # the system's or the user's own
    if [ -n "$(find $reason -mmin -$retry_after_min 2>/dev/null)" ] ||
        { [ -f $reason ] && cksum <tools/get_pdal.sh | cmp -s - $place/for-good; }; then
        give_up "$(cat $reason)"
    fi
fi
is_debian_12 || give_up "here it comes from conda (environment.yml); it is fetched on Debian 12 only"
for program in apt-cache apt-config apt-get awk dpkg timeout; do
    command -v $program >/dev/null 2>&1 || give_up "$program is missing on this system"
done
architecture=$(dpkg --print-architecture 2>/dev/null)

umask 022
build=$(mktemp -d "$PWD/$place.part.XXXXXX" 2>/dev/null) || give_up "this folder cannot be written"
trap 'rm -rf "$build"' EXIT
trap 'exit 130' INT TERM HUP
chmod 755 "$build" # apt's own user reads its keys and lists there
mkdir "$build/apt"
download
unpack
write_program
put_in_place
