# Not run. Builds from the tree that holds this file; a port of the registry downloads a release instead.
get_filename_component(SOURCE_PATH "${CMAKE_CURRENT_LIST_DIR}/../../../../.." ABSOLUTE)

vcpkg_check_linkage(ONLY_DYNAMIC_LIBRARY)
# The library has a C ABI and no debug form.
set(VCPKG_BUILD_TYPE release)
vcpkg_check_features(OUT_FEATURE_OPTIONS options FEATURES net WAYFOLD_NET)

vcpkg_cmake_configure(SOURCE_PATH "${SOURCE_PATH}/client/c" OPTIONS ${options})
vcpkg_cmake_install()
vcpkg_cmake_config_fixup(PACKAGE_NAME wayfold CONFIG_PATH lib/cmake/wayfold)
file(REMOVE "${CURRENT_PACKAGES_DIR}/lib/libwayfold.a")
vcpkg_install_copyright(FILE_LIST "${SOURCE_PATH}/LICENSE-APACHE" "${SOURCE_PATH}/LICENSE-MIT")
