import pytest

# Checks of scikit-learn on data with ten inputs and no two rows alike: the longest fits there are.
SLOW_CHECKS = ("check_regressor_data_not_an_array", "check_regressors_train")


def pytest_collection_modifyitems(items):
    for item in items:
        if "WishartProcessRegressor()-" in item.name and any(check in item.name for check in SLOW_CHECKS):
            item.add_marker(pytest.mark.slow)
