import pytest

from templates.store import InvalidIdentifier, TemplateStore, UnknownTenant


def test_a_tenant_is_made_once(store: TemplateStore) -> None:
    first = store.tenants.create("acme")
    assert store.tenants.create("acme").id == first.id == store.tenants.get("acme").id
    assert [tenant.name for tenant in store.tenants.all()] == ["acme", "default", "other"]


def test_a_bad_name_is_refused(store: TemplateStore) -> None:
    for name in ("", "x" * 65, "a b", "a/b", "ä", "a\n"):
        with pytest.raises(InvalidIdentifier, match="1 to 64"):
            store.tenants.create(name)


def test_an_unknown_tenant_is_said(store: TemplateStore) -> None:
    with pytest.raises(UnknownTenant, match="'nobody'"):
        store.tenants.get("nobody")
    with pytest.raises(UnknownTenant, match="epoch 2"):
        store.tenants.rotation_key("default", 2)


def test_enrollment_by_template_is_off_until_it_is_allowed(store: TemplateStore) -> None:
    assert not store.tenants.get("default").template_enrollment
    store.tenants.set_template_enrollment("default", True)
    assert store.tenants.get("default").template_enrollment
    assert not store.tenants.get("other").template_enrollment
    store.tenants.set_template_enrollment("default", False)
    assert not store.tenants.get("default").template_enrollment
    assert [line.outcome for line in store.audit_log.lines()] == [
        "template-enrollment-on",
        "template-enrollment-off",
    ]
    with pytest.raises(UnknownTenant):
        store.tenants.set_template_enrollment("nobody", True)
