// What the service's own page takes of this package.
export { base64url } from "../dist/bytes.js";
export { createPasskey, passkeyHolderKey, whyNoPasskey } from "../dist/service/passkey.js";
export { PrivateClient } from "../dist/service/private-client.js";
