const byId=id=>document.getElementById(id);
function connect(begin,tell){
  let ended=false;const source=new EventSource("/events"),state=byId("state");
  source.onopen=()=>{begin();state.textContent="Live"};
  source.onmessage=m=>tell(JSON.parse(m.data));
  source.addEventListener("end",()=>{ended=true;source.close();state.textContent="Ended"});
  source.onerror=()=>{if(!ended)state.textContent="Not reachable; it may have ended. Trying again"};
}
